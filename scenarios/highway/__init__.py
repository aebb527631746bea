"""Traffic of highway-env: a world that reacts, and recordings of what happens in it."""
