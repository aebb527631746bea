"""How a vehicle moves."""
