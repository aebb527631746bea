"""Tests of `asp_env.dynamics`."""
