"""Nouns, clock, readers and files."""
