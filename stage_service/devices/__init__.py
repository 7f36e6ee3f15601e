"""Drivers for the stage's devices; `docs/reference/wire.md` is the protocol."""
