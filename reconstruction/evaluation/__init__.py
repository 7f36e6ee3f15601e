"""Strands beside the truth: matching, visibility, connectivity, regions, baselines."""
