"""What pixels see of a scene whose outline is known."""

from __future__ import annotations

import numpy as np
import pytest

from appearance import HairAppearance, build_scene
from appearance.render.coverage import coverage, pixel_coverage
from reconstruction import Camera, Mesh, Strands

HAIR = HairAppearance((0.1, 0.1, 0.1), 0.3, 0.2)


@pytest.fixture(scope="module")
def scene():
    """A wall that covers the left 5 of 16 columns, and thick fibres over the right 4."""
    edge = -3 * 0.6 / 256  # metres at column 5, 0.6 m away
    corners = [[x, 0.0, z] for x in (-0.2, edge) for z in (-0.2, 0.2)]
    wall = Mesh(np.array(corners), np.array([[0, 1, 2], [1, 3, 2]]))
    places = np.arange(4 * 0.6 / 256 + 1e-3, 0.03, 5e-4)
    fibres = [np.array([[x, 0.0, 0.1], [x, 0.0, 0.0], [x, 0.0, -0.1]]) for x in places]
    strands = Strands.from_list(fibres)
    return build_scene(Strands(strands.points, strands.offsets, 1e-3), wall, hair=HAIR)


def camera() -> Camera:
    return Camera(
        name="front",
        K=np.array([[256.0, 0, 7.5], [0, 256, 7.5], [0, 0, 1]]),
        R=np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
        t=np.array([0, 0, 0.6]),
        width=16,
        height=16,
    )


def test_wall_and_fibres_cover_the_columns_that_they_stand_in(scene):
    head, hair = np.zeros((16, 16)), np.zeros((16, 16))
    head[:, :5], hair[:, 12:] = 1, 1
    found = coverage(scene, camera())
    np.testing.assert_array_equal(found["head"], head)
    np.testing.assert_array_equal(found["hair"], hair)
    for some in ([0, 4, 5, 11, 12, 255], []):
        few = pixel_coverage(scene, camera(), some)
        np.testing.assert_array_equal(few["head"], head.ravel()[np.array(some, int)])
        np.testing.assert_array_equal(few["hair"], hair.ravel()[np.array(some, int)])


def test_without_samples_it_is_an_error(scene):
    with pytest.raises(ValueError, match="spp must be positive"):
        coverage(scene, camera(), spp=0)
