"""What was measured and what may be known: recordings, maps, scenarios, scenes, forecasts."""
