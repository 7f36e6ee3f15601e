"""Fields of reflectance on fixed strands: what a fibre's model leaves to be told by the frames."""
