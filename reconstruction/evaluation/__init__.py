"""Evaluation of strands: matching, visibility, connectivity, baselines."""
