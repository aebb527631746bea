"""Metrics of driven episodes: scores, comfort, time to collision and realism."""
