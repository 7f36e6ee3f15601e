"""The scalp laid flat."""

from __future__ import annotations

import numpy as np
import pytest

from reconstruction import Mesh
from reconstruction.head.generic import generic_head
from reconstruction.head.scalp import find_scalp, sample_roots
from reconstruction.head.scalp_map import ScalpMap


@pytest.fixture(scope="module")
def flat() -> ScalpMap:
    return ScalpMap.of(generic_head())


def test_roots_have_their_place(flat: ScalpMap) -> None:
    roots, _ = sample_roots(find_scalp(generic_head()), 3000, seed=0)
    uv, distance = flat(roots)
    assert distance.max() < 1e-3
    assert uv.min() >= 0
    assert uv.max() <= 1
    assert np.ptp(uv, axis=0).min() > 0.95
    left, back = roots[:, 0] > 0.02, roots[:, 1] > 0.05
    assert uv[left, 0].min() > 0.5 > uv[roots[:, 0] < -0.02, 0].max()
    assert uv[back, 1].min() > uv[roots[:, 1] < -0.03, 1].max()


def test_no_two_places_share_a_uv_and_areas_are_nearly_kept(flat: ScalpMap) -> None:
    """Every vertex finds itself again by its (u, v); no face is turned over."""
    stretch = flat.stretch()
    assert stretch.min() > 0
    assert np.percentile(stretch, 1) > 0.6
    assert np.percentile(stretch, 99) < 1.5


def test_a_map_goes_with_its_template(flat: ScalpMap) -> None:
    """Roots of a head that was moved, enlarged and bent have the (u, v) that they had."""
    head = generic_head()
    roots, _ = sample_roots(find_scalp(head), 200, seed=1)

    def move(p: np.ndarray) -> np.ndarray:
        return 1.2 * p @ np.diag([-1.0, -1, 1]) + [0.1, 0, 0.02]

    moved = flat.on(Mesh(move(head.vertices), head.faces))
    np.testing.assert_allclose(moved(move(roots))[0], flat(roots)[0], atol=2e-3)
    with pytest.raises(ValueError, match="same faces"):
        flat.on(Mesh(head.vertices, head.faces[1:]))


def test_points_off_the_scalp_get_the_nearest_place(flat: ScalpMap) -> None:
    uv, distance = flat(np.array([[0, 0.01, 0.2], [0, -0.3, -0.05]]))
    assert ((uv >= 0) & (uv <= 1)).all()
    assert distance[0] == pytest.approx(0.085, abs=2e-3)
    assert uv[1, 1] < 0.2


def test_scalps_that_cannot_be_laid_flat_are_errors() -> None:
    head = generic_head()
    with pytest.raises(ValueError, match="marks no scalp"):
        ScalpMap.of(Mesh(head.vertices, head.faces))
    with pytest.raises(ValueError, match="marks no scalp"):
        ScalpMap.of(Mesh(head.vertices, head.faces, np.zeros(len(head.faces), bool)))
    with pytest.raises(ValueError, match=r"folds at \d+ of its"):
        ScalpMap.of(Mesh(head.vertices, head.faces, np.ones(len(head.faces), bool)))
    with pytest.raises(ValueError, match="expected uv for"):
        ScalpMap(head, np.zeros((3, 2)))
