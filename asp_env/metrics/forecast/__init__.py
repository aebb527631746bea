"""Metrics of forecasts: errors, calibration and feasibility."""
