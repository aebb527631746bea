"""Speeds, as ratios to a peer in the same run; run by hand, never as tests."""
