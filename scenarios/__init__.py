"""Where traffic comes from besides recordings."""
