"""Scalp regions and roots."""

from __future__ import annotations

import numpy as np
import pytest

from reconstruction import Mesh
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.head.scalp import NoScalp, find_scalp, sample_roots


def egg(stretch: float = 1.5, radius: float = 0.09, rings: int = 20) -> Mesh:
    polar = np.linspace(0, np.pi, rings + 1)
    around = np.arange(2 * rings) * np.pi / rings
    p, a = np.meshgrid(polar, around, indexing="ij")
    vertices = radius * np.stack(
        [np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), stretch * np.cos(p)], -1
    )
    n = len(around)
    i, j = (q.ravel() for q in np.meshgrid(np.arange(rings), np.arange(n), indexing="ij"))
    a0, a1, b0, b1 = i * n + j, i * n + (j + 1) % n, (i + 1) * n + j, (i + 1) * n + (j + 1) % n
    faces = np.concatenate([np.stack([a0, b0, a1], 1), np.stack([a1, b0, b1], 1)])
    return Mesh(vertices.reshape(-1, 3), faces)


def shell(where) -> VoxelGrid:  # type: ignore[no-untyped-def]
    """Hair 2 to 15 mm off the egg, where `where(centers)` holds."""
    grid = VoxelGrid(np.full(3, -0.165), 3e-3, np.ones((111, 111, 111), bool))
    centers = grid.centers()
    radius = np.linalg.norm(centers / [1, 1, 1.5], axis=1)
    inside = (radius > 0.092) & (radius < 0.105) & where(centers)
    return VoxelGrid(grid.origin, grid.spacing, inside.reshape(111, 111, 111))


def marked() -> Mesh:
    mesh = egg(stretch=1.0)
    return Mesh(mesh.vertices, mesh.faces, mesh.vertices[mesh.faces].mean(axis=1)[:, 2] > 0.03)


def test_a_marked_scalp_is_taken_at_its_word() -> None:
    mesh = marked()
    scalp = find_scalp(mesh)
    assert scalp.marked
    assert mesh.scalp is not None
    np.testing.assert_array_equal(scalp.share, mesh.scalp)
    assert scalp.area == pytest.approx(mesh.face_areas()[mesh.scalp].sum())
    assert scalp.points[:, 2].min() > 0.02


def test_an_unmarked_scalp_is_where_hair_lies_on_the_head() -> None:
    """Hair all over but on the face (towards -y): no roots on the face nor deep at the neck."""
    scalp = find_scalp(egg(), shell(lambda c: (c[:, 1] > -0.03) | (c[:, 2] > 0.06)))
    assert not scalp.marked
    face = (scalp.points[:, 1] < -0.05) & (scalp.points[:, 2] < 0.03)
    assert not face.any()
    assert scalp.points[:, 2].max() > 0.13
    back = scalp.points[scalp.points[:, 1] > 0.05]
    assert back[:, 2].min() < -0.02
    assert scalp.points[:, 2].min() > -0.09


def test_no_hair_on_the_head_is_an_error() -> None:
    with pytest.raises(NoScalp, match="are in one"):
        find_scalp(egg(), shell(lambda c: np.zeros(len(c), bool)))
    with pytest.raises(NoScalp, match="marks no scalp"):
        find_scalp(egg())


def test_roots_are_uniform_by_area_and_on_the_skin() -> None:
    mesh = marked()
    roots, normals = sample_roots(find_scalp(mesh), 4000, seed=1)
    assert len(roots) == 4000
    np.testing.assert_allclose(np.linalg.norm(roots, axis=1), 0.09, rtol=0.01)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-9)
    assert (roots * normals).sum(axis=1).min() > 0.08
    # a cap's area grows linearly with its height: heights of uniform roots are uniform
    height = np.sort(roots[:, 2])
    expected = np.linspace(height[0], height[-1], len(height))
    assert np.abs(height - expected).max() < 0.002


def test_the_seed_is_the_result() -> None:
    scalp = find_scalp(marked())
    a, b, c = (sample_roots(scalp, 50, seed=s)[0] for s in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)
    with pytest.raises(ValueError, match="positive"):
        sample_roots(scalp, 0, seed=0)
