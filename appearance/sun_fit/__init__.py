"""Roughness and colour of hair from OLAT frames (Sun et al. 2021, §5)."""
