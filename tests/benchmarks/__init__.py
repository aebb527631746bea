"""Benchmarks, which compare rates within one run. They are started by hand and are not tests."""
