"""Forecasters, learned and physical, and how they are trained."""
