"""Tests of frames, videos and windows."""
