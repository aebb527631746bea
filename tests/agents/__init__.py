"""Agents that learn in the environments, and the demonstrations that they learn from."""
