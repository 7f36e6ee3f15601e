"""The device side of each wire."""
