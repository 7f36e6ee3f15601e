"""Strands along analytic fields, and their way to the scalp."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from reconstruction import Mesh
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.growth.field import OrientationField, to_tensors
from reconstruction.growth.from_roots import (
    Coverage,
    Tracing,
    fill_gaps,
    grow_from_roots,
    trace,
)
from reconstruction.growth.rooting import root_all
from reconstruction.head.scalp import Scalp


def analytic(direction, shape=(41, 41, 9), spacing=1e-3, inside=None) -> OrientationField:  # type: ignore[no-untyped-def]
    """A field known at every voxel, about the origin; signs are scrambled as a solver's are."""
    size = np.array(shape)
    grid = VoxelGrid(-(size - 1) / 2 * spacing, spacing, np.ones(shape, bool))
    if inside is not None:
        centers = grid.centers(np.argwhere(grid.inside))
        grid = VoxelGrid(grid.origin, spacing, inside(centers).reshape(shape))
    centers = grid.centers()
    d = direction(centers)
    d = d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-12)
    d *= np.random.default_rng(0).choice([-1, 1], len(d))[:, None]
    ones, none = np.ones(len(d)), np.zeros(len(d), bool)
    return OrientationField(grid, to_tensors(d + 1e-15), d, ones, ~none, none, none)


def circles(p: np.ndarray) -> np.ndarray:
    return np.stack([-p[:, 1], p[:, 0], np.zeros(len(p))], axis=1) + np.array([1e-9, 0, 0])


def up(p: np.ndarray) -> np.ndarray:
    return np.tile([0, 0, 1.0], (len(p), 1))


def drift(step: float) -> float:
    """How far a strand strays from its circle of 12 mm radius over half a turn, metres."""
    field = analytic(circles, (61, 61, 5), 5e-4)
    start, along = np.array([[12e-3, 0, 0]]), np.array([[0, 1.0, 0]])
    (path,) = trace(field, start, along, Tracing(step, np.pi * 12e-3))
    assert len(path) > 5
    return abs(float(np.linalg.norm(path[-1, :2])) - 12e-3)


def test_steps_are_of_second_order() -> None:
    assert drift(1e-3) < 5e-5  # half a millimetre by Euler steps of half the length
    assert drift(2e-3) > 3 * drift(1e-3)


def helices(p: np.ndarray) -> np.ndarray:
    """A lock: 31 mm a turn."""
    return np.stack([-p[:, 1], p[:, 0], np.full(len(p), 5e-3)], axis=1)


@pytest.mark.slow
def test_strands_do_not_depend_on_threads() -> None:
    field = analytic(helices, (29, 29, 61))
    roots = np.random.default_rng(0).uniform([-0.01, -0.01, -0.03], [0.01, 0.01, 0.02], (4500, 3))
    normals = np.tile([0, 0, 1.0], (len(roots), 1))
    one, many = (grow_from_roots(field, roots, normals, threads=t) for t in (1, 4))
    assert len(one) > 3000
    assert all(np.array_equal(a, b) for a, b in zip(one, many, strict=True))
    assert grow_from_roots(field, roots[:0], normals[:0]) == []


def test_sign_follows_the_way_and_paths_end_at_the_envelope() -> None:
    field = analytic(up, (5, 5, 41))
    starts = np.zeros((2, 3))
    paths = trace(field, starts, np.array([[0.2, 0, 1.0], [0.2, 0, -1.0]]))
    assert paths[0][-1, 2] == pytest.approx(20e-3, abs=1e-3)
    assert paths[1][-1, 2] == pytest.approx(-20e-3, abs=1e-3)
    np.testing.assert_allclose(np.diff(paths[0][:, 2]), 5e-4, rtol=1e-3)


def test_length_is_limited() -> None:
    field = analytic(up, (5, 5, 41))
    paths = trace(field, np.zeros((1, 3)), np.array([[0, 0, 1.0]]), Tracing(max_length=5e-3))
    assert len(paths[0]) == 11
    with pytest.raises(ValueError, match="step"):
        Tracing(step=0.0)


def test_nothing_grows_where_there_is_no_orientation() -> None:
    field = analytic(lambda p: np.zeros((len(p), 3)), (5, 5, 41))
    paths = trace(field, np.zeros((1, 3)), np.array([[0, 0, 1.0]]))
    assert len(paths[0]) == 1


def test_roots_are_led_to_an_envelope_that_stays_clear_of_the_skin() -> None:
    field = analytic(up, (9, 9, 41))
    low = field.grid.origin[2]
    roots = np.array([[0, 0, low - 4e-3], [0, 0, low - 30e-3]])
    strands = grow_from_roots(field, roots, np.tile([0, 0, 1.0], (2, 1)))
    assert len(strands) == 1  # the second is too far below
    np.testing.assert_allclose(strands[0][0], roots[0], atol=1e-7)
    assert strands[0][-1, 2] > 0.019


def test_gaps_are_filled_and_reproducibly() -> None:
    field = analytic(up, (15, 15, 31))
    first, second = (fill_gaps(field, Coverage(field), seed=4, batch=40) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
    coverage = Coverage(field)
    for path in first:
        coverage.add(path)
    assert len(coverage.gaps()) < 0.01 * len(field.directions)
    assert all(np.ptp(p[:, 2]) > 0.028 for p in first)


def test_no_gap_is_filled_that_no_strand_leads_to_from_what_was_measured() -> None:
    whole = analytic(up, (31, 15, 31))
    near = whole.grid.centers()[:, 0] < 0
    field = dataclasses.replace(whole, measured=near)
    strands = fill_gaps(field, Coverage(field), seed=4, within=2e-3)
    assert strands
    assert max(float(s[:, 0].max()) for s in strands) < 3e-3
    assert not fill_gaps(dataclasses.replace(whole, measured=near & False), Coverage(field), seed=4)


def flat_scalp() -> Scalp:
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-0.02, 0.02, 21)] * 2))
    mesh = Mesh(
        np.array([[-0.02, -0.02, 0], [0.02, -0.02, 0], [0, 0.02, 0]]), np.array([[0, 1, 2]])
    )
    points = np.stack([x, y, np.zeros_like(x)], axis=1)
    return Scalp(mesh, points, np.tile([0, 0, 1.0], (len(x), 1)), np.ones(1), True)


def line(a: tuple[float, ...], b: tuple[float, ...], n: int = 40) -> np.ndarray:
    return np.linspace(a, b, n).astype(np.float32)


def test_ends_beside_the_scalp_are_led_to_it_root_first() -> None:
    loose = [line((0.0, 0, 0.05), (0, 0, 4e-3))]
    result = root_all([], loose, flat_scalp())
    assert (result.to_scalp, result.joined, result.dropped) == (1, 0, 0)
    assert result.strands[0][0, 2] == 0
    assert result.strands[0][-1, 2] == pytest.approx(0.05)


def test_loose_strands_join_a_rooted_neighbour_and_chains_follow() -> None:
    rooted = [line((0, 0, 0), (0, 0, 0.05))]
    loose = [
        line((2e-3, 0, 0.12), (2e-3, 0, 0.05)),  # goes on where the rooted one ends, upside down
        line((3e-3, 0, 0.12), (3e-3, 0, 0.20)),  # goes on where that one ends
        line((0.1, 0, 0.1), (0.1, 0, 0.15)),  # far from everything
    ]
    result = root_all(rooted, loose, flat_scalp())
    assert (result.to_scalp, result.joined, result.dropped) == (0, 2, 1)
    for strand in result.strands:
        np.testing.assert_allclose(strand[0], 0, atol=1e-6)
        steps = np.diff(strand, axis=0)
        assert (steps[:, 2] > 0).all()  # no turning back, no doubled points
    longest = max(float(s[-1, 2]) for s in result.strands)
    assert longest == pytest.approx(0.20)


def test_a_strand_over_the_scalp_rises_from_under_it_and_runs_as_its_neighbour_does() -> None:
    """A neighbour says which end is the root's, though the other one lies lower."""
    rooted = [line((-0.02, 0, 0), (-0.02, 0, 0.02)), line((-0.015, 0, 0.02), (0.02, 0, 0.02))]
    loose = [line((-5e-3, 1e-3, 0.021), (0.01, 1e-3, 0.018))]
    result = root_all(rooted, [*loose, loose[0][::-1]], flat_scalp())
    assert (result.to_scalp, result.joined, result.dropped) == (0, 2, 0)
    for strand in result.strands[2:]:
        assert strand[0, 2] == 0
        np.testing.assert_array_equal(strand[-len(loose[0]) :], loose[0])
        steps = np.diff(strand, axis=0)
        steps /= np.linalg.norm(steps, axis=1, keepdims=True)
        assert steps[0, 2] > 0.9  # out of the skin
        bend = np.degrees(np.arccos((steps[1:] * steps[:-1]).sum(axis=1).clip(-1, 1)))
        assert bend.max() < 15
        assert strand[:, 2].max() < 0.022


def test_strands_without_neighbours_are_extended_to_the_scalp_or_dropped() -> None:
    loose = [line((0, 0, 0.035), (0.01, 0, 0.015)), line((0, 0, 0.05), (0.01, 0, 0.045))]
    result = root_all([], loose, flat_scalp())
    assert (result.to_scalp, result.joined, result.dropped) == (1, 0, 1)
    np.testing.assert_array_equal(result.strands[0][-40:], loose[0][::-1])


def test_a_neighbour_across_the_way_is_no_way_to_the_root() -> None:
    rooted = [line((-0.02, 0, 0.05), (0.02, 0, 0.05))]
    loose = [line((0, 0, 0.052), (0, 0, 0.10))]
    assert root_all(rooted, loose, flat_scalp()).dropped == 1


def test_hair_shorter_than_the_shortest_that_is_kept_elsewhere_grows() -> None:
    field = analytic(up, (9, 9, 21))
    low, short = field.grid.origin, Tracing(max_length=4e-3)
    (strand,) = grow_from_roots(field, low[None], np.array([[0, 0, 1.0]]), short)
    assert strand[-1, 2] - strand[0, 2] == pytest.approx(4e-3, abs=1e-4)
    assert fill_gaps(field, Coverage(field), short, seed=4)


def test_where_nothing_has_an_orientation_nothing_is_covered() -> None:
    field = dataclasses.replace(analytic(up, (3, 3, 3)), degenerate=np.ones(27, bool))
    assert Coverage(field).share() == 0


@pytest.mark.parametrize(("loose", "reaches"), [(18, True), (24, False)])
def test_copies_of_one_way_to_the_scalp_do_not_root_a_patch(loose: int, reaches: bool) -> None:
    """Of 30,561 strands of a patch of curls 443 reached the scalp, and the others copied them."""
    rooted = [line((0, 0, 0), (0, 0, 0.05))]
    x = np.linspace(-2e-3, 2e-3, loose)
    result = root_all(rooted, [line((a, 0, 0.05), (a, 0, 0.1)) for a in x], flat_scalp())
    assert (result.joined, result.dropped, result.reaches) == (loose, 0, reaches)


@pytest.mark.parametrize(("near", "reaches"), [(0, False), (1, True)])
def test_connections_from_afar_alone_do_not_root_a_patch(near: int, reaches: bool) -> None:
    """Of a patch of curls no strand grew from the scalp, and 22,868 were led to it through hair
    that nothing showed: four fifths of all metres."""
    x = np.linspace(-0.02, 0.02, 20)
    beside = [line((0, 0.02, 5e-3), (0, 0.02, 0.05))] * near
    result = root_all(
        [], [line((a, -0.02, 0.03), (a, -0.02, 0.1)) for a in x] + beside, flat_scalp()
    )
    assert (result.led, result.to_scalp, result.reaches) == (20, 20 + near, reaches)
