"""Cameras: the interface and its backends."""
