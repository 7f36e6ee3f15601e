"""Frames of the simulated cameras."""
