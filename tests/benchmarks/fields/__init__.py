"""Fields of reflectance on fixed strands."""
