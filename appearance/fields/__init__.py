"""Fields of reflectance on fixed strands: what the captured frames show beyond the fibre model."""
