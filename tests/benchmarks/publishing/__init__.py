"""A public benchmark: captures with true strands, written in open formats."""
