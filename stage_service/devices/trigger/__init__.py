"""Trigger boxes: the interface and its backends."""
