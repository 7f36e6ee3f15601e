"""Which frames a fit observes."""

import numpy as np

from appearance.observations import far_apart


def test_directions_far_apart():
    # from one pole of an octahedron: the other pole, then the equator
    octahedron = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, -2], [-1, 0, 0], [0, -1, 0]])
    order = far_apart(octahedron.astype(float), 9)
    assert order[:2] == [0, 3]
    assert sorted(order) == list(range(6))
    assert far_apart(octahedron.astype(float), 1) == [0]
