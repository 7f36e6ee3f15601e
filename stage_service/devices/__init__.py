"""Drivers for the stage's devices; `docs/wire.md` is the protocol."""
