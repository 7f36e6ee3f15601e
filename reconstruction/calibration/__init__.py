"""A stage's geometry from captures of a board and of spheres; see `solve.calibrate`."""
