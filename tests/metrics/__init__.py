"""Errors of forecasts and scores of drives."""
