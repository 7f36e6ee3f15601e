"""Strands refined together, against lines that were measured on waves."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.strands import Strands
from reconstruction.growth.lines import Lines
from reconstruction.growth.refinement import _product, _solve, refine, supported
from reconstruction.growth.selection import without_exposed_ends
from reconstruction.reconstruct_options import RefineOptions
from reconstruction.tangents.estimate import Measured

LENGTH, WAVE = 60e-3, 40e-3


def wave(s: np.ndarray, aside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and unit tangents at `s (N,)` metres along z of waves that are moved by `aside`."""
    k = 2 * np.pi / WAVE
    p = np.stack([3e-3 * np.sin(k * s), np.zeros_like(s), s], axis=1) + aside
    d = np.stack([3e-3 * k * np.cos(k * s), np.zeros_like(s), np.ones_like(s)], axis=1)
    return p, d / np.linalg.norm(d, axis=1, keepdims=True)


ASIDE = np.array([[x, y, 0.0] for x in (0, 4e-3, 8e-3) for y in (0, 4e-3)])
"""Six strands, 4 mm apart."""


def lines(
    noise: float, angle_deg: float, below: float = 0.0, together: float | None = None
) -> Measured:
    """Lines measured on all six from `below` metres on, with errors across and of angle.

    Those of angle swing along each strand with a period of `together` metres; None: at random.
    """
    rng = np.random.default_rng(2)
    s = rng.uniform(below, LENGTH, 600)
    which = rng.integers(0, len(ASIDE), len(s))
    p, d = wave(s, ASIDE[which])
    p += noise * rng.normal(size=p.shape)
    if together is None:
        d += np.radians(angle_deg) * rng.normal(size=d.shape)
    else:
        phase = rng.uniform(0, 2 * np.pi, (len(ASIDE), 2))[which]
        swing = np.sin(2 * np.pi * s[:, None] / together + phase)
        d[:, :2] += np.radians(angle_deg) * 2**0.5 * swing
    d *= rng.choice([-1, 1], (len(d), 1)) / np.linalg.norm(d, axis=1, keepdims=True)
    return Measured(p, d, rng.uniform(0.5, 1.0, len(p)))


def strands(copies: int, off: float) -> Strands:
    """Each of the six `copies` times, shifted and bent by about `off` metres but at its root."""
    rng = np.random.default_rng(3)
    s = np.arange(0, LENGTH, 2e-3)
    rise = (1 - np.exp(-s / 10e-3))[:, None]
    out = []
    for aside in np.repeat(ASIDE, copies, axis=0):
        bend = rng.normal(size=3) + np.sin(s / 4e-3 + rng.uniform(0, 6))[:, None] * rng.normal(
            size=3
        )
        out.append(wave(s, aside)[0] + off * rise * bend * [1, 1, 0])
    return Strands.from_list(out)


def errors(made: Strands) -> tuple[float, float]:
    """Median distance (metres) to the true waves and angle (degrees) to them."""
    s = np.arange(0, LENGTH, 1e-4)
    p, d = (np.concatenate(part) for part in zip(*[wave(s, a) for a in ASIDE], strict=True))
    distance, i = cKDTree(p).query(made.points)
    cosine = np.abs((d[i] * made.tangents()).sum(axis=1)).clip(0, 1)
    return float(np.median(distance)), float(np.degrees(np.median(np.arccos(cosine))))


@pytest.mark.parametrize(("noise", "angle_deg"), [(0.0, 0.0), (3e-4, 10.0)])
def test_strands_come_nearer_to_the_waves_that_lines_were_measured_on(
    noise: float, angle_deg: float
) -> None:
    start = strands(1, 5e-4)
    made, figures = refine(
        start, lines(noise, angle_deg), RefineOptions(steps=4, marginal_coverage=0)
    )
    before, after = errors(start), errors(made)
    assert after[0] < 0.6 * before[0]
    assert after[1] < 0.8 * before[1]
    assert figures["removed"] == 0
    np.testing.assert_allclose(made.roots, start.roots, atol=1e-7)


def test_more_steps_do_not_follow_the_noise_of_lines_further() -> None:
    """Six strands for each measured one: most are held by no line, all are turned by some."""
    start, noisy = strands(6, 2e-4), lines(3e-4, 10.0)
    few, many = (
        errors(refine(start, noisy, RefineOptions(steps=n, marginal_coverage=0))[0])
        for n in (3, 12)
    )
    assert many[0] < 1.1 * few[0]
    assert many[1] < 1.15 * few[1]


def test_directions_that_are_off_together_do_not_carry_strands_away() -> None:
    """As those of lines are that were read from the same pixels."""
    start, swinging = strands(6, 5e-4), lines(3e-4, 10.0, together=30e-3)
    made, _ = refine(start, swinging, RefineOptions(marginal_coverage=0))
    assert errors(made)[0] < 0.9 * errors(start)[0]


def test_the_size_of_blocks_does_not_change_the_strands(monkeypatch: pytest.MonkeyPatch) -> None:
    start, noisy = strands(6, 2e-4), lines(3e-4, 10.0)
    whole, _ = refine(start, noisy, RefineOptions())
    for room in ("lines", "selection", "refinement"):
        monkeypatch.setattr(f"reconstruction.growth.{room}.BLOCK", 50)
    made, _ = refine(start, noisy, RefineOptions())
    np.testing.assert_array_equal(made.offsets, whole.offsets)
    np.testing.assert_allclose(made.points, whole.points, atol=1e-7)


def test_copies_and_strands_across_the_measured_ones_go() -> None:
    many = strands(6, 1e-4)
    across = [np.linspace([-5e-3, 2e-3, z], [13e-3, 2e-3, z], 10) for z in (0.01, 0.03)]
    given = Strands.from_list([many[i] for i in range(len(many))] + across)
    made, figures = refine(given, lines(2e-4, 5.0), RefineOptions(steps=0, marginal_coverage=0.2))
    assert len(ASIDE) <= len(made) <= 3 * len(ASIDE)  # of six copies each
    truth = np.concatenate([wave(np.arange(0, LENGTH, 1e-3), a)[0] for a in ASIDE])
    assert cKDTree(made.points).query(truth)[0].max() < 2e-3  # none of the six is lost
    assert np.abs(made.tangents()[:, 0]).max() < 0.8  # none that runs across is left
    assert figures["removed"] == len(given) - len(made)


def test_points_far_from_every_line_hardly_move() -> None:
    start = strands(1, 5e-4)
    made, _ = refine(
        start, lines(0.0, 0.0, below=40e-3), RefineOptions(steps=3, marginal_coverage=0)
    )
    low = start.points[:, 2] < 15e-3
    moved = np.linalg.norm(made.points - start.points, axis=1)
    assert moved[low].max() < 0.2 * np.median(moved[start.points[:, 2] > 45e-3])


@pytest.mark.parametrize(
    ("before", "expected"),
    [
        (1e-3, 0.8e-3),  # in front of what is seen there
        (-0.5e-3, 0.95e-3),  # behind it, but not out of sight
        (-4e-3, 4e-3),  # out of sight
        (8e-3, -8e-3),  # nothing of that surface
    ],
)
def test_unmeasured_points_stay_hidden_from_cameras(before: float, expected: float) -> None:
    """A wall 0.5 m before a camera that looks along y; lines are measured on its left half.

    What moves comes to the mean of 1 mm behind it (± 1 mm) and of where it was (± 3 mm).
    """
    axes = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    camera = Camera(
        name="c",
        K=np.array([[500.0, 0, 49.5], [0, 500, 49.5], [0, 0, 1]]),
        R=axes,
        t=-axes @ [0, -0.5, 0],
        width=100,
        height=100,
    )
    z = np.arange(-0.03, 0.03, 1e-3)
    observed = np.stack([np.full_like(z, -0.02), np.zeros_like(z), z], axis=1)
    up = np.tile([0.0, 0.0, 1.0], (len(z), 1))
    given = Strands.from_list([observed, observed + np.array([0.04, -before, 0])])
    surface = np.full((100, 100), 0.5)
    made, figures = refine(
        given,
        Measured(observed, up, np.ones(len(z))),
        RefineOptions(marginal_coverage=0),
        [(camera, surface)],
    )
    middle = slice(len(z) + 20, len(z) + 50)  # the root stands
    np.testing.assert_allclose(made.points[: len(z)], observed, atol=1e-6)  # what is measured stays
    np.testing.assert_allclose(made.points[middle, 1], expected, atol=0.1e-3)
    np.testing.assert_allclose(made.points[len(z)], given.points[len(z)], atol=1e-6)
    surface[:] = 0  # a camera that sees no hair there says nothing
    still, _ = refine(
        given,
        Measured(observed, up, np.ones(len(z))),
        RefineOptions(marginal_coverage=0),
        [(camera, surface)],
    )
    np.testing.assert_allclose(still.points, given.points, atol=1e-6)
    assert figures["guessed_in_front_before"] == (0.5 if before == 1e-3 else 0.0)
    assert figures["guessed_in_front"] < 0.05  # the root


@pytest.mark.parametrize(("behind", "kept"), [(0.0, 31), (20e-3, 61)])
def test_an_exposed_end_that_no_line_supports_is_cut_off(behind: float, kept: int) -> None:
    """Lines on the lower half of a strand; its upper half bends to `behind` the visible wall.

    Hidden hair stays, since no camera contradicts it. A strand without any line stays, too.
    """
    axes = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    K = np.array([[500.0, 0, 49.5], [0, 500, 49.5], [0, 0, 1]])
    camera = Camera(name="c", K=K, R=axes, t=-axes @ [0, -0.5, 0], width=100, height=100)
    z = np.linspace(-0.03, 0.03, 61)
    path = np.stack([0 * z, np.where(z > 0, behind, 0.0), z], axis=1)
    low = path[:31]
    up = np.tile([0.0, 0.0, 1.0], (len(low), 1))
    measured = Lines(Measured(low, up, np.ones(len(low))))
    given = Strands.from_list([path, path + np.array([0.03, 0.0, 0.0])])
    out = without_exposed_ends(given, measured, [(camera, np.full((100, 100), 0.5))])
    counts = np.diff(out.offsets)
    assert counts[0] == pytest.approx(kept, abs=4)  # support reaches 2.4 mm beyond the last line
    assert counts[1] == 61
    np.testing.assert_array_equal(out.roots, given.roots)


@pytest.mark.parametrize(
    ("near", "kept", "share"), [(np.inf, 1, 1.0), (30e-3, 1, 0.575), (10e-3, 2, 0.149)]
)
def test_a_surface_far_from_all_lines_contradicts_no_strand(
    near: float, kept: int, share: float
) -> None:
    """Two strands on a wall 0.5 m before a camera; lines on one of them, 20 mm from the other.

    The share is the area of a rectangle with two half discs, within the 10 cm that the camera sees.
    """
    axes = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    K = np.array([[500.0, 0, 49.5], [0, 500, 49.5], [0, 0, 1]])
    camera = Camera(name="c", K=K, R=axes, t=-axes @ [0, -0.5, 0], width=100, height=100)
    z = np.arange(-0.03, 0.03, 1e-3)
    swept = np.stack([np.full_like(z, -0.01), np.zeros_like(z), z], axis=1)
    up = np.tile([0.0, 0.0, 1.0], (len(z), 1))
    made, figures = refine(
        Strands.from_list([swept, swept + np.array([0.02, 0, 0])]),
        Measured(swept, up, np.ones(len(z))),
        RefineOptions(),
        [(camera, np.full((100, 100), 0.5))],
        near=near,
    )
    assert len(made) == kept
    assert figures["surface_near_lines"] == pytest.approx(share, abs=0.01)


def test_lines_that_are_denser_support_and_cover_less_far() -> None:
    measured = lines(0.0, 0.0)
    assert Lines(measured).width == pytest.approx(1e-3)
    assert Lines(measured, 5e-4).width == pytest.approx(4e-4)
    aside = Strands.from_list([np.linspace([1e-3, 0, 0], [1e-3, 0, 50e-3], 51)])
    straight = Measured(
        np.linspace([0, 0, 0], [0, 0, 50e-3], 51), np.tile([0, 0, 1.0], (51, 1)), np.ones(51)
    )
    wide, narrow = (supported(aside, straight, apart) for apart in (np.inf, 5e-4))
    assert wide[25] == pytest.approx(np.exp(-0.5), rel=1e-3)
    assert narrow[25] == pytest.approx(np.exp(-0.5 * 2.5**2), rel=1e-3)


def test_the_banded_solution_and_product_are_the_dense_ones() -> None:
    rng, n = np.random.default_rng(4), 7
    blocks = rng.normal(size=(3, n, 3, 3))
    blocks[0] = blocks[0] @ blocks[0].transpose(0, 2, 1) + 30 * np.eye(3)
    dense = np.zeros((3 * n, 3 * n))
    for block in range(3):
        for i in range(n - block):
            part = np.s_[3 * i : 3 * i + 3], np.s_[3 * (i + block) : 3 * (i + block) + 3]
            dense[part] = blocks[block, i].T
            dense[part[::-1]] = blocks[block, i]
    right = rng.normal(size=(n, 3))
    wanted = np.linalg.solve(dense, right.ravel()).reshape(n, 3)
    np.testing.assert_allclose(_solve(blocks, right), wanted, rtol=1e-9)
    np.testing.assert_allclose(_product(blocks, wanted), right, atol=1e-12)


def test_confidence_is_that_of_the_line_that_agrees_best_and_0_far_from_all() -> None:
    along = np.array([0.0, 0, 1])
    straight = Strands.from_list([np.linspace([0, 0, 0], [0, 0, 50e-3], 51)])
    at = np.array([[0, 0, 10e-3], [1e-3, 0, 20e-3], [0, 0, 30e-3]])
    leant = np.array([0, np.sin(np.radians(10)), np.cos(np.radians(10))])
    measured = Measured(at, np.stack([along, along, leant]), np.array([0.8, 0.8, 0.8]))
    confidence = supported(straight, measured)
    np.testing.assert_allclose(confidence[[10, 20, 30]], 0.8 * np.exp([0, -0.5, -0.5]), rtol=1e-4)
    assert not confidence[35:].any()
    assert not supported(straight, Measured.none()).any()


def test_asking_more_of_strands_than_any_has_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"no strand adds refine\.marginal_coverage 1 per"):
        refine(strands(1, 0.0), lines(0.0, 0.0), RefineOptions(marginal_coverage=1.0))
