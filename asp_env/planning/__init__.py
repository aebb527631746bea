"""What the ego does about a forecast."""
