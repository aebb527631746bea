"""Judging predictors and planners: runs, intervals, tables and reports."""
