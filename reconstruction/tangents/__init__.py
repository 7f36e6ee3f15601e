"""3D directions of hair: candidates, scoring, reflection, and their estimate."""
