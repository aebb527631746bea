"""Worlds, drivers, rewards and observations."""
