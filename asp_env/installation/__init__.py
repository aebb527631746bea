"""What is installed, what can be used with it, and which public recordings exist."""
