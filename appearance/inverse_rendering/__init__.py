"""Stage 1: the hair's BSDF, varying over the scalp, and the lamps, by inverse rendering."""
