"""Closed-loop evaluation: a planner drives the ego by forecasts."""
