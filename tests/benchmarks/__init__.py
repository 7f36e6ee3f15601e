"""Benchmarks: error against run time beside named peers; run by `make bench`."""
