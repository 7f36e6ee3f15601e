"""Ground floor: calibrated geometry, capture folders, and strands from images."""
