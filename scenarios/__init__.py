"""Sources of traffic other than recordings: SUMO and highway-env."""
