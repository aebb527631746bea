"""Scenarios: where an episode begins and which vehicle is the ego, selected by tags and measures."""
