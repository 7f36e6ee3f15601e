"""Photometric line stereo: shadow bits match pixels across views, lines give segments (Sun §4)."""
