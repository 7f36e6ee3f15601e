"""Inverse rendering: the hair's BSDF, varying over the scalp, and the lights."""
