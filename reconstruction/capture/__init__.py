"""Capture folders: read, written, verified, compressed, imported, and views of them."""
