"""Tests of `scenarios.highway`."""
