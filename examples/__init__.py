"""Short programs to start from; each runs on what is shipped."""
