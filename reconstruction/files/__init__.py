"""Files whole on the disk or not there: EXR, points, strands."""
