"""Hair that no camera sees: its density from depths, and the copies of strands that fill it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from reconstruction import Mesh, Model, ReconstructOptions, Report
from reconstruction.arrays import Array
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.strands import Strands
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.growing import GrowingStages
from reconstruction.growth.hidden import FIBRE, Density, hidden_strands, measured_density, seen_by
from reconstruction.head.scalp import find_scalp
from reconstruction.light_planes import PointCloud
from reconstruction.report.report import silent

SIDE, DEEP = 40e-3, 20e-3
DENSE = 4e6
"""Metres in a cubic metre: 4 m in 1 cm³."""


def first_hits(density: float, count: int, seed: int = 0) -> Array:
    """Points `(N, 3)` under z = 0 that rays along -z meet first and a lamp 45° aside lights.

    Level straight fibres of width `FIBRE` at random places and angles fill `DEEP` metres, and
    `count` rays fall on the middle of them. A fibre stops what passes within half its width.
    """
    rng = np.random.default_rng(seed)
    across = 2**0.5 * (SIDE + 2 * DEEP)
    fibres = rng.poisson(density * across * DEEP)  # a random line has 1 / across m in 1 m²
    angle = rng.uniform(0, np.pi, fibres)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    offset = rng.uniform(-0.5, 0.5, fibres) * across
    depth = np.sort(rng.uniform(0, DEEP, fibres))
    found = []
    for x in rng.uniform(-SIDE / 2, SIDE / 2, (count, 2)):
        hit = np.flatnonzero(np.abs(normal @ x - offset) < FIBRE / 2)
        if not len(hit):
            continue
        z = depth[hit[0]]
        above = depth < z
        way = normal[above] @ x + normal[above, 0] * (z - depth[above])
        if not (np.abs(way - offset[above]) < FIBRE / 2).any():
            found.append([*x, -z])
    return np.array(found)


@pytest.mark.parametrize("density", [3e6, 4e6, 8e6])
def test_depths_of_first_fibres_show_how_dense_they_are(density: float) -> None:
    found = measured_density(first_hits(density, 4000))
    assert found is not None
    assert np.median(found.values) == pytest.approx(density, rel=0.25)


def test_noise_of_half_the_depth_hides_an_eighth_of_the_hair() -> None:
    """Independent deviations add as squares: 1 - 1 / sqrt(1.25) = 11 %."""
    points = first_hits(DENSE, 4000)
    clean, noisy = measured_density(points), None
    assert clean is not None
    noise = 0.5 * clean.depth * np.random.default_rng(1).normal(size=points.shape)
    noisy = measured_density(points + noise)
    assert noisy is not None
    assert noisy.depth / clean.depth == pytest.approx(1.25**0.5, abs=0.05)


def test_few_points_and_points_in_one_place_and_on_a_plane() -> None:
    rng = np.random.default_rng(0)
    assert measured_density(np.zeros((0, 3))) is None
    assert measured_density(rng.uniform(0, 1, (200, 3))) is None  # 10 cm from one another
    for points in (np.zeros((100, 3)), rng.uniform(0, 0.02, (4000, 3)) * (1, 1, 0)):
        found = measured_density(points)
        assert found is not None
        assert np.median(found.values) == pytest.approx(0.5 / FIBRE**2)  # a fibre a fibre deep


def box(*size: float, spacing: float = 1e-3) -> VoxelGrid:
    """A full envelope about the origin whose top is at z = 0."""
    shape = np.round(np.array(size) / spacing).astype(int)
    origin = spacing * (0.5 - shape / 2) * (1, 1, 0) - (0, 0, spacing * (shape[2] - 0.5))
    return VoxelGrid(origin, spacing, np.ones(shape, bool))


def even(density: float) -> Density:
    return Density(np.zeros((1, 3)), np.array([density]), 1e-3)


def above(size: int = 200) -> Camera:
    """A camera 1 m over the origin that looks down on 80 mm."""
    f = size / 0.08
    K = np.array([[f, 0, (size - 1) / 2], [0, f, (size - 1) / 2], [0, 0, 1.0]])
    return Camera("above", size, size, K, np.diag([1.0, -1, -1]), np.array([0, 0, 1.0]))


def waves(count: int = 41) -> Strands:
    """Strands along x on top of `box(0.04, ...)`, waves of 1 mm."""
    x = np.arange(-0.02, 0.0201, 1e-3)
    sine = 1e-3 * np.sin(x / 4e-3)
    return Strands.from_list(
        [np.stack([x, y + sine, 0 * x - 5e-4], axis=1) for y in np.linspace(-0.019, 0.019, count)]
    )


def filled(strands: Strands, grid: VoxelGrid, density: Density, **more: int) -> list[Array]:
    found, figures = hidden_strands(
        strands, grid, density, lambda p: p[:, 2] > -1e-3, **{"most": 100_000, **more}
    )
    assert figures["added"] == len(found)
    return [np.asarray(p, float) for p in found]


@pytest.mark.parametrize("spacing", [0.7e-3, 1e-3, 2e-3])
def test_an_envelope_is_filled_to_its_density_out_of_sight(spacing: float) -> None:
    grid = box(0.04, 0.04, 0.03, spacing=spacing)
    found = filled(waves(), grid, even(2e6))
    metres = Strands.from_list(found).lengths().sum()
    # 2 m in each of 48 cm³, less what the visible strands hold; the visible millimetre stays empty
    assert metres == pytest.approx(2 * 48 - waves().lengths().sum(), rel=0.12)
    points = np.concatenate(found)
    assert points[:, 2].max() < -1e-3 + 1e-6
    assert grid.contains(points).all()
    share = np.histogram(points[:, 2], bins=[-0.03, -0.02, -0.01, -0.002])[0] / len(points)
    assert share == pytest.approx([10 / 28, 10 / 28, 8 / 28], abs=0.06)


def test_copies_have_the_shape_of_their_models() -> None:
    """That of the sine: cos(x / 4 mm) / 4 is its slope."""
    for p in filled(waves(), box(0.04, 0.04, 0.03), even(1e6))[:50]:
        step = np.diff(p, axis=0)
        assert np.abs(step[:, 2]).max() < 1e-6
        slope = step[:, 1] / step[:, 0]
        assert np.abs(slope).max() < 0.26
        assert np.ptp(slope) > 0.2  # at least 10 mm of a wave of 25 mm


def test_no_copy_without_room_and_no_more_than_asked_for() -> None:
    grid = box(0.04, 0.04, 0.01)
    assert filled(waves(), grid, even(1e4)) == []
    assert (
        filled(waves(), grid, even(4e6), most=0) == filled(waves(), grid, even(4e6), most=-5) == []
    )
    assert len(filled(waves(), grid, even(4e6), most=7)) == 7
    assert filled(waves(1), grid, even(4e6)) != []  # one strand is model enough


def test_cameras_see_up_to_measured_points_and_strands_or_else_into_the_envelope(
    cloud_of: Callable[..., PointCloud],
) -> None:
    """Points at z = 0 on the left, strands at z = -6 mm at x = 20 mm; the envelope is at z = 0."""
    x, y = np.meshgrid(np.arange(-0.039, 0, 1e-4), np.arange(-0.039, 0.039, 1e-4))
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    points = points[np.hypot(x + 0.02, y).ravel() > 1.8e-3]  # a hole is covered by what is around
    cloud = cloud_of(points, np.zeros(len(points), int), ["above"])
    along = np.linspace(-0.01, 0.01, 21)
    low = Strands.from_list([np.stack([0 * along + 0.02, along, 0 * along - 6e-3], axis=1)])
    seen = seen_by([(above(), np.full((200, 200), 1.0))], cloud, low, depth=1e-3)
    depths = np.array([0.9e-3, 1.1e-3, 6.9e-3, 7.1e-3, 7.9e-3, 8.1e-3])

    def at(x: float) -> list[bool]:
        return seen(np.stack([0 * depths + x, 0 * depths, -depths], axis=1)).tolist()

    assert at(-0.02) == at(-0.01) == [True, False, False, False, False, False]
    assert at(0.02) == at(0.0217) == [True, True, True, False, False, False]
    assert at(0.01) == at(0.0225) == [True, True, True, True, True, False]
    assert at(0.12) == [False] * 6  # outside the image


@pytest.mark.parametrize(
    ("pixel", "count", "given", "why"),
    [
        (0.5e-3, 3000, None, None),
        (0.5e-3, 3000, 1.0, None),
        (1.8e-3, 3000, 1.0, None),
        (0.5e-3, 3000, 0.0, "options"),
        (0.5e-3, 0, None, "without a sweep"),
        (0.5e-3, 5, None, "too few points"),
        (1.8e-3, 3000, None, "pixels of 1.8 mm are wider than 1.7 mm"),
    ],
)
def test_the_stage_fills_or_says_why_not(
    tmp_path: Path,
    cloud_of: Callable[..., PointCloud],
    pixel: float,
    count: int,
    given: float | None,
    why: str | None,
) -> None:
    points = first_hits(DENSE, 6000)[:count].reshape(-1, 3)
    options = ReconstructOptions(hidden_density=given)
    stages = GrowingStages(Model(tmp_path), options, silent, Report())
    cloud, grid = cloud_of(points, np.zeros(len(points), int), ["above"]), box(0.04, 0.04, 0.03)
    surfaces = [(above(), np.full((200, 200), 1.0))]
    out = stages.with_hidden(waves(), None, grid, cloud, surfaces, pixel)
    stage = stages.report["hidden"]
    if why is not None:
        assert why in stage.left_out[0].why
        assert len(out) == len(waves())
        return
    assert not stage.left_out
    assert out.lengths().sum() == pytest.approx(48 * (given or 4), rel=0.25)
    assert stage.figures["metres_in_cm3"] == pytest.approx(given or 4, rel=0.25)


def test_copies_are_rooted_where_strands_are(
    tmp_path: Path, cloud_of: Callable[..., PointCloud]
) -> None:
    """Upright hair 20 mm long on a level scalp."""
    x, y = np.meshgrid(np.linspace(-0.019, 0.019, 8), np.linspace(-0.019, 0.019, 8))
    z = np.arange(-0.02, -4e-4, 1e-3)
    own = Strands.from_list(
        [np.stack([0 * z + a, 0 * z + b, z], axis=1) for a, b in np.c_[x.ravel(), y.ravel()]]
    )
    corners = np.array([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1.0]]) * 0.02
    skin = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.ones(2, bool))
    scalp = find_scalp(skin)
    stages = GrowingStages(Model(tmp_path), ReconstructOptions(), silent, Report())
    points = first_hits(DENSE, 3000)
    cloud = cloud_of(points, np.zeros(len(points), int), ["above"])
    out = stages.with_hidden(own, scalp, box(0.04, 0.04, 0.02), cloud, [], 0.5e-3)
    assert np.abs(out.roots[:, 2] + 0.02).max() < 1.1e-3
    # 4 m in each of 32 cm³ would be 6,400 hairs of 2 cm: 650 cm² of scalp have 125,000 (Robbins)
    assert len(out) == pytest.approx(125_000 * 16 / 650, abs=1)
    assert (
        "as many strands as the 3076 hairs of the scalp" in stages.report["hidden"].left_out[0].why
    )
