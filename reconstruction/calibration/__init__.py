"""Calibration of a stage from captures of a board and spheres; see `solve.calibrate`."""
