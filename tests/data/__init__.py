"""Tests of `asp_env.data`."""
