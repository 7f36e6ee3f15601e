"""Pieces of strands matched one to one, and their parts replaced."""

from __future__ import annotations

import numpy as np
from benchmarks.appearance.error_parts import PARTS, Mixture, Pieces, matched

from appearance import HairAppearance
from appearance.bsdf.maps import HairMaps
from reconstruction import Strands

PIXEL = 2e-3


def pieces(points: np.ndarray, seed: int, radius: float) -> Pieces:
    rng = np.random.default_rng(seed)
    vector = np.tile([0.0, 0.0, -PIXEL], (len(points), 1))
    sigma = rng.uniform(0.1, 1, (len(points), 3))
    return Pieces(points, vector, sigma, np.full(len(points), radius))


def test_each_point_has_one_partner_and_the_nearest_come_first() -> None:
    ours = np.zeros((3, 6))
    ours[:, 0] = 0.1, 0.3, 9.0
    true = np.zeros((3, 6))
    true[:, 0] = 0.0, 1.2, 20.0
    a, b = matched(ours, true, 2.0)
    assert dict(zip(a.tolist(), b.tolist(), strict=True)) == {0: 0, 1: 1}
    assert len(matched(ours, true[:0], 2.0)[0]) == 0


def test_all_parts_replaced_are_the_truth_and_none_are_ours() -> None:
    rng = np.random.default_rng(0)
    true = pieces(rng.uniform(-0.05, 0.05, (400, 3)), 1, 4e-4)
    shifted = np.concatenate([true.middle[:300] + 3e-4, rng.uniform(0.2, 0.3, (50, 3))])
    ours = pieces(shifted, 2, 3e-4)
    mixture = Mixture(ours, true, PIXEL)
    assert mixture.figures["matched_share_of_truth"] == 0.75
    assert np.isclose(mixture.figures["median_distance_mm"], 0.3 * 3**0.5)
    for made, wanted in ((mixture.pieces(PARTS), true), (mixture.pieces(()), ours)):
        for name in ("middle", "vector", "absorption", "radius"):
            one, other = (getattr(x, name)[np.lexsort(x.middle.T)] for x in (made, wanted))
            np.testing.assert_allclose(one, other)
    grown = mixture.pieces(("missing",))
    assert len(grown.radius) == 450
    assert np.isclose(grown.radius, 3e-4).all(), "as thick as ours until thickness is replaced"


def test_pieces_have_the_length_and_the_absorption_of_their_place() -> None:
    line = np.linspace([0.0, 0, 0], [0, 0, -0.1], 30)
    strands = Strands.from_list([line, line + 0.05], 1e-4)
    hair = HairAppearance((0.1, 0.1, 0.1), 0.3, 0.3)
    absorption = np.zeros((2, 2, 3))
    absorption[1, 1] = 1.0  # the second strand's tip
    uv = np.array([[0.25, 0.5], [0.75, 0.5]])
    found = Pieces.of(strands, HairMaps.each(hair, absorption), uv, 5e-3)
    np.testing.assert_allclose(np.linalg.norm(found.vector, axis=1).sum(), 0.2, rtol=1e-5)
    second = found.middle[:, 0] > 0.02
    assert not found.absorption[~second].any()
    depth = -(found.middle[second, 2] - 0.05) / 0.1
    np.testing.assert_allclose(found.absorption[second, 0], depth, atol=0.01)
