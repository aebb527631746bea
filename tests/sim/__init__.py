"""Tests of worlds, drivers, rewards and observations."""
