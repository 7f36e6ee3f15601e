"""Shadow rays from strands and head: what stands between a point and a light is known here."""

from __future__ import annotations

import numpy as np

from appearance.render.visibility import above_faces, reached, within_fibres
from appearance.scene.hair_appearance import HairAppearance
from appearance.scene.hair_scene import build_scene
from reconstruction import Mesh, Strands

LIGHT = np.array([0.0, 0, 2])


def test_a_plate_and_a_fibre_shade_what_is_below_them_and_not_themselves():
    """Fibres along x: one above the plate, two below it, one of those beside its edge."""
    corners = np.array([[x, y, 0.0] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]) * 0.1
    plate = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    x = np.linspace(-0.05, 0.05, 9)
    places = [(0.0, 0.05), (0.0, -0.05), (0.3, -0.05), (0.3, -0.06)]
    lines = [np.stack([x, 0 * x + y, 0 * x + z], axis=1) for y, z in places]
    strands = Strands.from_list(lines, radius=2e-3)
    scene = build_scene(strands, plate, hair=HairAppearance((0.1, 0.1, 0.1), 0.3, 0.3))
    points = strands.points.astype(float)
    # straight from the middles: the fourth hangs below the third as the light of infinity sees it
    lit = reached(scene, points, LIGHT, np.zeros_like(points)).reshape(4, 9)
    assert lit[0].all()
    assert not lit[1].any()
    assert lit[2].all()
    spread = within_fibres(points, LIGHT, np.full(len(points), 2e-3), seed=3)
    assert np.abs(np.einsum("nk,nk->n", spread, LIGHT - points)).max() < 1e-9
    assert np.linalg.norm(spread, axis=1).max() <= 2e-3
    assert reached(scene, points, LIGHT, spread).reshape(4, 9)[[0, 2]].all()
    lifted = above_faces(corners, plate.faces)
    np.testing.assert_allclose(lifted / np.linalg.norm(lifted[0]), [[0, 0, 1]] * 4, atol=1e-12)
    # the outermost corners, past the fibre above the middle
    assert reached(scene, corners, LIGHT, lifted).all()
    assert not reached(scene, corners, -LIGHT, lifted).any()
