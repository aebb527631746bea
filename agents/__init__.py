"""Agents that learn to drive in the environments, from rewards or from logged drivers."""
