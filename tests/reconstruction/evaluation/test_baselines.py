"""The visual hull, and the two baselines that fill it."""

from __future__ import annotations

import numpy as np
import pytest

from reconstruction import Camera, Mesh, Strands
from reconstruction.evaluation.baselines import (
    SPACING,
    baseline_hull,
    hull_smooth_field,
    hull_vertical,
    with_true_directions,
)
from reconstruction.evaluation.matching import compare_strands
from reconstruction.geometry.lights import dome_positions
from reconstruction.geometry.mesh_queries import mesh_silhouette
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.images.visual_hull import trim_edges, visual_hull


def ball(radius: float, center: tuple[float, float, float] = (0, 0, 0)) -> Mesh:
    """A closed sphere of triangles."""
    rows, columns = 24, 48
    theta, phi = np.linspace(0, np.pi, rows + 1), np.arange(columns) * 2 * np.pi / columns
    t, p = (a.ravel() for a in np.meshgrid(theta, phi, indexing="ij"))
    xyz = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=1)
    faces = []
    for i in range(rows):
        for j in range(columns):
            a, b = i * columns + j, i * columns + (j + 1) % columns
            faces += [[a, a + columns, b], [b, a + columns, b + columns]]
    return Mesh(np.array(center) + radius * xyz, np.array(faces))


@pytest.fixture(scope="module")
def cameras() -> list[Camera]:
    return [
        Camera.look_at(f"cam_{i}", 96, 80, position, [0, 0, 0], 22)
        for i, position in enumerate(dome_positions(12, 1.0, -30.0))
    ]


def masks_of(cameras: list[Camera], mesh: Mesh) -> dict[str, np.ndarray]:
    return {c.name: mesh_silhouette(c, mesh) for c in cameras}


def test_silhouette_of_a_ball(cameras: list[Camera]) -> None:
    mask = mesh_silhouette(cameras[0], ball(0.08))
    focal = cameras[0].K[0, 0]
    radius = focal * np.tan(np.arcsin(0.08))
    assert np.pi * (radius - 0.1) ** 2 < mask.sum() < np.pi * (radius + 0.6) ** 2


def test_hull_holds_the_ball_and_little_more(cameras: list[Camera]) -> None:
    hull = visual_hull(cameras, masks_of(cameras, ball(0.08)), spacing=2e-3)
    inner = ball(0.077).vertices
    assert hull.contains(inner).all()
    assert not hull.contains(ball(0.12).vertices).any()
    assert hull.volume == pytest.approx(4 / 3 * np.pi * 0.08**3, rel=0.15)
    index = hull.index(hull.centers())
    np.testing.assert_array_equal(index, np.argwhere(hull.inside))


def test_blocks_carve_as_single_voxels_do(cameras: list[Camera]) -> None:
    masks = masks_of(cameras, ball(0.06, (0.01, 0.02, 0)))
    hull = visual_hull(cameras, masks, spacing=5e-3, bounds=[[-0.1, -0.09, -0.11], [0.1, 0.1, 0.1]])
    everywhere = np.argwhere(np.ones_like(hull.inside))
    points = hull.centers(everywhere)
    inside = np.ones(len(points), bool)
    for c in cameras:
        pixels, _ = c.project(points)
        column, row = np.clip(np.rint(pixels), 0, [c.width - 1, c.height - 1]).astype(int).T
        inside &= c.inside(pixels) & masks[c.name][row, column]
    np.testing.assert_array_equal(hull.inside.ravel(), inside)


def test_a_cropped_image_does_not_carve_past_its_edge(cameras: list[Camera]) -> None:
    near = Camera.look_at("near", 60, 60, [0, -1, 0], [0, 0, 0.02], 8)
    mesh = ball(0.08)
    views = [*cameras, near]
    masks = masks_of(views, mesh)
    assert masks["near"][-1].any()
    whole = visual_hull(cameras, masks, spacing=4e-3)
    cropped = visual_hull(views, masks, spacing=4e-3)
    assert cropped.volume == pytest.approx(whole.volume, rel=0.02)
    masks["near"] = trim_edges(masks["near"], np.zeros_like(masks["near"]))
    assert visual_hull(views, masks, spacing=4e-3).volume < 0.9 * whole.volume


def test_hull_errors(cameras: list[Camera]) -> None:
    with pytest.raises(ValueError, match="no camera has a mask"):
        visual_hull(cameras, {}, spacing=1e-3)
    with pytest.raises(ValueError, match=r"cam_0: its mask must be \(80, 96\)"):
        visual_hull(cameras, {"cam_0": np.ones((3, 3), bool)}, spacing=1e-3)
    with pytest.raises(ValueError, match="cam_1: its mask is empty"):
        visual_hull(cameras, {"cam_1": np.zeros((80, 96), bool)}, spacing=1e-3)
    with pytest.raises(ValueError, match="too large"):
        visual_hull(cameras, masks_of(cameras, ball(0.08)), spacing=5e-5)
    masks = masks_of(cameras, ball(0.03))
    masks["cam_0"] = np.roll(masks["cam_0"], 40, axis=1)
    with pytest.raises(ValueError, match="no volume in common"):
        visual_hull(cameras, masks, spacing=2e-3)


def test_baseline_hull_leaves_out_the_head_and_what_is_before_its_face(
    cameras: list[Camera],
) -> None:
    """Hair is a ball behind the head: before the face, pixels show no hair and are carved."""
    head, hair = ball(0.06), ball(0.06, (0, 0.05, 0.02))
    masks = {}
    for c in cameras:
        nearer = c.project(np.zeros(3))[1] < c.project(np.array([0, 0.05, 0.02]))[1]
        behind = mesh_silhouette(c, head) if nearer else np.zeros((c.height, c.width), bool)
        masks[c.name] = mesh_silhouette(c, hair) & ~behind
    hull = baseline_hull(cameras, masks, head, spacing=3e-3)
    assert not hull.contains(ball(0.055).vertices).any()
    assert not hull.contains(np.array([0, -0.064, 0])).any()
    assert hull.contains(np.array([0, 0.1, 0.03])).all()
    bounds = np.array([[-0.02, 0.07, 0.0], [0.02, 0.11, 0.05]])
    part = baseline_hull(cameras, masks, head, spacing=3e-3, bounds=bounds)
    assert part.contains(np.array([0, 0.1, 0.03])).all()
    centers = part.centers()
    assert ((centers >= bounds[0] - 3e-3) & (centers <= bounds[1] + 3e-3)).all()


@pytest.fixture(scope="module")
def box() -> VoxelGrid:
    inside = np.zeros((30, 30, 40), bool)
    inside[2:-2, 2:-2, 2:-2] = True
    inside[10:14, 10:14, 18:22] = False
    return VoxelGrid(np.zeros(3), 2e-3, inside)


def test_vertical_lines_fill_the_hull(box: VoxelGrid) -> None:
    lines = hull_vertical(box)
    assert (lines.points[::2, 2] > lines.points[1::2, 2]).all()
    middles = lines.resampled(1e-3).points
    inside = box.contains(middles + np.array([0, 0, 1e-6], np.float32))
    assert inside.mean() > 0.98  # the ends lie on the hull's surface
    assert lines.lengths().sum() * SPACING**2 == pytest.approx(box.volume, rel=0.03)


def test_vertical_lines_find_vertical_hair(box: VoxelGrid) -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform(0.006, 0.05, (40, 2))
    true = Strands.from_list([np.array([[x, y, 0.07], [x, y, 0.05]]) for x, y in xy])
    scores = compare_strands(hull_vertical(box), true)["all"]["1mm_10deg"]
    assert scores["recall"] == 1.0
    assert scores["precision"] < 0.1


def test_smooth_field_runs_down_the_sides(box: VoxelGrid) -> None:
    pieces = hull_smooth_field(box)
    assert np.allclose(pieces.lengths(), SPACING, rtol=1e-3)
    assert box.contains(pieces.points.reshape(-1, 2, 3).mean(axis=1)).all()
    center = pieces.points.reshape(-1, 2, 3).mean(axis=1)
    direction = pieces.tangents()[::2]
    side = (center[:, 0] < 0.008) & (np.abs(center[:, 2] - 0.04) < 0.02)
    assert np.abs(direction[side, 2]).min() > 0.97


def test_smooth_field_falls_from_the_crown_of_a_dome() -> None:
    ijk = np.stack(np.meshgrid(*[np.arange(40)] * 3, indexing="ij"), axis=-1)
    radius = np.linalg.norm(ijk - 19.5, axis=-1)
    head = ball(0.028, (0.039, 0.039, 0.039))
    grid = VoxelGrid(np.zeros(3), 2e-3, (radius < 18) & (radius > 14.5))
    pieces = hull_smooth_field(grid, head)
    center = pieces.points.reshape(-1, 2, 3).mean(axis=1) - 0.039
    out = center / np.linalg.norm(center, axis=1, keepdims=True)
    down = np.array([0, 0, -1]) + out[:, 2:] * out
    steepness = np.linalg.norm(down, axis=1)
    some = steepness > 0.4
    angle = np.abs((pieces.tangents()[::2] * down).sum(axis=1)[some] / steepness[some])
    assert np.quantile(angle, 0.05) > 0.97


def test_true_directions_are_the_mean_over_a_cube() -> None:
    # in one cube of 4 mm two strands 30° to either side of z, in the next one along y, then none
    steepness = np.tan(np.radians(30)) * 2e-3
    true = Strands.from_list(
        [
            np.array([[0.001, 0.002 - steepness, 0], [0.001, 0.002 + steepness, 0.004]]),
            np.array([[0.002, 0.002 + steepness, 0], [0.002, 0.002 - steepness, 0.004]]),
            np.array([[0.006, 0.0, 0.002], [0.006, 0.004, 0.002]]),
        ]
    )
    ours = Strands.from_list([np.array([[0.0005, 0.002, 0.002], [0.0125, 0.002, 0.002]])])
    pieces = with_true_directions(ours, true, 4e-3)
    middle, tangent = pieces.points.reshape(-1, 2, 3).mean(axis=1), np.abs(pieces.tangents()[::2])
    assert np.allclose(middle, ours.resampled(1e-3).points, atol=1e-6), "they stay in their places"
    assert pieces.lengths() == pytest.approx(1e-3, rel=1e-3)
    for cube, axis in ((0, 2), (1, 1), (2, 0)):
        there = np.floor(middle[:, 0] / 4e-3) == cube
        assert there.sum() >= 4
        assert tangent[there, axis] == pytest.approx(1.0, abs=1e-4)


def test_distant_strands_keep_their_direction() -> None:
    true = Strands.from_list([np.array([[0.002, 0.002, 0.002], [0.002, 0.002, 0.1]])])
    at = np.array([[0.001, 0.001, 0.05], [1e5, 1e5, 1e5]])
    ours = Strands.from_list([np.array([p, p + np.array([0.02, 0, 0])]) for p in at])
    pieces = with_true_directions(ours, true, 4e-3)
    middle, tangent = pieces.points[::2], np.abs(pieces.tangents()[::2])
    inside = (middle[:, 0] < 3.9e-3) & (tangent[:, 2] > 0.999)
    assert inside.sum() >= 2
    assert (tangent[(middle[:, 0] > 4.6e-3) & (middle[:, 0] < 1), 0] > 0.999).all()
    assert (middle[:, 0] > 1).any()


def test_true_directions_of_no_strands_are_none() -> None:
    true = Strands.from_list([np.array([[0, 0, 0], [0, 0, 0.1]])])
    assert len(with_true_directions(Strands.from_list([]), true, 1e-3)) == 0
