"""Plugs for asp-env: a predictor, a planner, a driver, a reader and a view."""
