"""Shooting a plan: sequencing, accounting for frames, staying safe."""
