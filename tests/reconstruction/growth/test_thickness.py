"""Radii of strands that are more, and elsewhere denser, than hair."""

from __future__ import annotations

import numpy as np
import pytest

from reconstruction.geometry.strands import Strands
from reconstruction.growth.thickness import HEAD_OF_HAIR, THICKEST, THINNEST, covering_radii

EDGE, LENGTH, SPACING = 40, 0.06, 2e-3


def lawn(copies: int) -> tuple[Strands, np.ndarray]:
    """Upright strands 2 mm apart, and which points are of the half with `copies` times as many."""
    rng = np.random.default_rng(0)
    i, j = np.divmod(np.arange(EDGE**2), EDGE)
    root = 2e-3 * np.stack([i, j, rng.uniform(size=len(i))], axis=1)
    dense = np.repeat(root[i >= EDGE // 2], copies, axis=0)
    root = np.concatenate([root[i < EDGE // 2], dense])
    root += rng.uniform(-1e-3, 1e-3, root.shape)
    rise = np.arange(0, LENGTH, SPACING)[:, None] * (0, 0, 1)
    points = (root[:, None] + rise).reshape(-1, 3).astype(np.float32)
    of_dense = np.repeat(np.arange(len(root)) >= EDGE**2 // 2, len(rise))
    return Strands(points, len(rise) * np.arange(len(root) + 1)), of_dense


@pytest.mark.parametrize(("copies", "within"), [(2, 0.15), (4, 0.15), (8, 0.25)])
def test_no_half_of_a_lawn_covers_more_than_the_mean(copies: int, within: float) -> None:
    """The mean density is that over the volume: (1 + copies)/2 of the sparse half's."""
    strands, dense = lawn(copies)
    radius = covering_radii(strands)
    each = min(HEAD_OF_HAIR / len(strands), THICKEST)
    assert np.median(radius[~dense]) == pytest.approx(each)
    wanted = max(each * (1 + copies) / 2 / copies, THINNEST)
    assert np.median(radius[dense]) == pytest.approx(wanted, rel=within)


def test_strands_of_one_density_keep_a_head_of_hairs_coverage() -> None:
    strands, _ = lawn(1)
    radius = covering_radii(strands)
    assert radius.max() == pytest.approx(min(HEAD_OF_HAIR / len(strands), THICKEST))
    assert np.median(radius) > 0.9 * radius.max()


@pytest.mark.parametrize("count", [1, 2, 40])
def test_strands_at_one_place_and_few_strands_have_radii(count: int) -> None:
    """All distances are 0 where every strand is the same one, of two points."""
    points = np.tile(np.array([[0, 0, 0], [0, 0, 1e-3]], np.float32), (count, 1))
    for p in (points, 0 * points):
        radius = covering_radii(Strands(p, 2 * np.arange(count + 1)))
        assert radius.shape == (2 * count,)
        assert (radius >= np.float32(THINNEST)).all()
        assert (radius <= np.float32(THICKEST)).all()


def test_no_strands_have_no_radii() -> None:
    assert covering_radii(Strands.from_list([])).shape == (0,)


def test_a_strand_far_from_all_others_does_not_thin_them() -> None:
    near, _ = lawn(2)
    both = Strands(
        np.concatenate([near.points, [[9, 9, 9], [9, 9, 9.1]]]),
        np.append(near.offsets, len(near.points) + 2),
    )
    alone = covering_radii(near)
    np.testing.assert_allclose(covering_radii(both)[: len(alone)], alone, rtol=1e-2)
