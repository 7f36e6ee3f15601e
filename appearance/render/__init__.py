"""Renderers: many lights at once, scanline sweeps, environments, coverage."""
