"""Open-loop evaluation: forecasts against the recorded future."""
