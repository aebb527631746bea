"""Tests of the package `predictors`."""
