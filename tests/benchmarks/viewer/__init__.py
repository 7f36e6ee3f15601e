"""The viewer: its light beside the path tracer's, and frames a second."""
