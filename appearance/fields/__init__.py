"""Reflectance fields on fixed strands, beyond the fibre model."""
