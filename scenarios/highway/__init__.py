"""highway-env's traffic: a world that reacts, and recordings of it."""
