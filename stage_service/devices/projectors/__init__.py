"""Projector controllers: the interface and its backends."""
