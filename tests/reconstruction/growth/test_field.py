"""Orientation fields: the solver against the plain reference, and the tensors' invariants."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from reconstruction import Camera, Mesh
from reconstruction.geometry.mesh_queries import depth_map, inside_mesh, mesh_depth, surface_samples
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.growth.field import gather, principal, solve_field, to_tensors
from reconstruction.growth.laplace import (
    Multigrid,
    conjugate_gradients,
    grid_laplacian,
)
from reconstruction.images.visual_hull import space_carve


def box(*shape: int, spacing: float = 1e-3) -> VoxelGrid:
    return VoxelGrid(np.zeros(3), spacing, np.ones(shape, bool))


def ball_mesh(radius: float, rings: int = 24, open_below: bool = False) -> Mesh:
    """A latitude-longitude sphere about the origin, outward faces; optionally without its foot."""
    polar = np.linspace(0, np.pi, rings + 1)[: -4 if open_below else None]
    around = np.arange(2 * rings) * np.pi / rings
    p, a = np.meshgrid(polar, around, indexing="ij")
    vertices = radius * np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], -1)
    n = len(around)
    i, j = (q.ravel() for q in np.meshgrid(np.arange(len(polar) - 1), np.arange(n), indexing="ij"))
    a0, a1, b0, b1 = i * n + j, i * n + (j + 1) % n, (i + 1) * n + j, (i + 1) * n + (j + 1) % n
    faces = np.concatenate([np.stack([a0, b0, a1], 1), np.stack([a1, b0, b1], 1)])
    return Mesh(vertices.reshape(-1, 3), faces)


directions = hnp.arrays(float, (5, 3), elements=st.floats(-1, 1).map(lambda x: round(x, 3))).filter(
    lambda a: (np.linalg.norm(a, axis=1) > 0.1).all()
)


@given(directions)
@settings(max_examples=50, deadline=None)
def test_a_tensor_and_its_main_axis_say_the_same_line(d: np.ndarray) -> None:
    tensors = to_tensors(d)
    np.testing.assert_allclose(tensors, to_tensors(-d))
    axes, values = principal(tensors)
    unit = d / np.linalg.norm(d, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs((axes * unit).sum(axis=1)), 1, atol=1e-9)
    np.testing.assert_allclose(values, np.tile([1.0, 0, 0], (5, 1)), atol=1e-9)


def test_zero_direction_is_refused() -> None:
    with pytest.raises(ValueError, match="zero"):
        to_tensors(np.zeros((1, 3)))


def test_laplacian_is_symmetric_and_passes_no_flux() -> None:
    inside = np.random.default_rng(0).random((6, 7, 8)) > 0.3
    L = grid_laplacian(inside)
    assert abs(L - L.T).max() == 0
    np.testing.assert_allclose(L.sum(axis=1), 0, atol=1e-12)


def random_problem(seed: int = 1) -> tuple[object, np.ndarray]:
    rng = np.random.default_rng(seed)
    inside = rng.random((24, 24, 24)) > 0.1
    L = grid_laplacian(inside)
    fixed = rng.random(L.shape[0]) < 0.03
    free = np.flatnonzero(~fixed)
    A = L[free][:, free]
    b = -(L[free][:, np.flatnonzero(fixed)] @ rng.random((int(fixed.sum()), 3)))
    # islands without data are singular; a touch of mass keeps this test's problem definite
    A = A + 1e-6 * np.eye(1)[0, 0] * _eye(A.shape[0])
    return A, b


def _eye(n: int) -> object:
    from scipy import sparse

    return sparse.eye_array(n, format="csr")


def test_conjugate_gradients_agree_with_a_direct_solve() -> None:
    from scipy.sparse import csc_matrix
    from scipy.sparse.linalg import splu

    A, b = random_problem()
    exact = splu(csc_matrix(A)).solve(b)
    x, series = conjugate_gradients(A, b, np.full(b.shape, 0.5), 1e-9)
    np.testing.assert_allclose(x, exact, atol=1e-5)
    errors = [e for _, e in series.points]
    assert errors[-1] <= 1e-9
    assert len(errors) < 60


def test_preconditioner_is_symmetric() -> None:
    """Conjugate gradients need u·Mv = v·Mu."""
    A, _ = random_problem()
    M = Multigrid(A)
    assert M.levels
    rng = np.random.default_rng(0)
    u, v = rng.normal(size=(2, A.shape[0], 1))
    left, right = float((u * M(v)).sum()), float((v * M(u)).sum())
    assert abs(left - right) < 1e-9 * abs(left) + 1e-9
    assert float((u * M(u)).sum()) > 0


def test_solver_without_convergence_raises_an_error() -> None:
    A, b = random_problem()
    with pytest.raises(RuntimeError, match="after 2 iterations"):
        conjugate_gradients(A, b, np.zeros(b.shape), 1e-9, limit=2)


def test_field_is_linear_between_two_plates_and_keeps_its_data() -> None:
    """Between plates with x and y lines, entry xx falls linearly: the exact harmonic answer."""
    grid = box(3, 3, 11)
    ends = np.array([[i, j, k] for i in range(3) for j in range(3) for k in (0, 10)]) * 1e-3
    lines = np.where(ends[:, 2:] == 0, [[1.0, 0, 0]], [[0, 1.0, 0]])
    field, series = solve_field(grid, ends, lines, tolerance=1e-10)
    xx = field.tensors.reshape(3, 3, 11, 6)[1, 1, :, 0]
    np.testing.assert_allclose(xx, np.linspace(1, 0, 11), atol=1e-8)
    assert field.measured.sum() == 18
    assert field.degenerate.reshape(3, 3, 11)[1, 1, 5]  # x and y equally likely: no direction
    assert not field.directions[field.degenerate].any()
    assert series is not None
    assert series.name.startswith("multigrid")


def test_trace_and_eigenvalues_stay_in_range() -> None:
    rng = np.random.default_rng(2)
    grid = box(14, 14, 14)
    field, _ = solve_field(
        grid,
        rng.random((60, 3)) * 13e-3,
        rng.normal(size=(60, 3)),
        tolerance=1e-8,
    )
    np.testing.assert_allclose(field.tensors[:, :3].sum(axis=1), 1, atol=1e-6)
    values = principal(field.tensors)[1]
    assert values.min() > -1e-6
    assert values.max() < 1 + 1e-6


def test_a_piece_without_data_is_empty_not_invented() -> None:
    inside = np.ones((4, 4, 9), bool)
    inside[:, :, 4] = False
    grid = VoxelGrid(np.zeros(3), 1e-3, inside)
    field, _ = solve_field(grid, np.zeros((1, 3)), np.array([[0, 0, 1.0]]))
    far = field.voxel(np.array([[0, 0, 8e-3]]))
    assert field.empty[far].all()
    assert not field.empty[field.voxel(np.zeros((1, 3)))].any()
    assert field.empty.sum() == 64


def test_points_just_outside_go_to_the_nearest_voxel() -> None:
    inside = np.zeros((5, 5, 5), bool)
    inside[2, 2, 2] = True
    grid = VoxelGrid(np.zeros(3), 1.0, inside)
    points = np.array([[2.9, 2.2, 2.0], [4.9, 2, 2]])
    voxels, _, weight = gather(grid, points, np.ones((2, 3)), np.array([2.0, 5.0]))
    assert voxels.tolist() == [0]
    assert weight.tolist() == [2.0]


def test_sampling_signs_by_the_way_one_goes() -> None:
    """Neighbours of opposite sign average to the line, not to nothing."""
    grid = box(2, 1, 1)
    points = np.array([[0, 0, 0], [1e-3, 0, 0]])
    field, _ = solve_field(grid, points, np.array([[0, 0, 1.0], [0, 0, -1.0]]))
    middle = np.array([[5e-4, 0, 0]])
    for sign in (1, -1):
        d, good = field.sample(middle, np.array([[0, 0.1, sign]]))
        assert good.all()
        np.testing.assert_allclose(d, [[0, 0, sign]], atol=1e-12)
    assert not field.sample(np.array([[1.0, 0, 0]]), np.array([[0, 0, 1.0]]))[1].any()


def test_no_data_and_no_envelope_are_errors() -> None:
    nothing = np.zeros((0, 3))
    with pytest.raises(ValueError, match="no orientation was measured"):
        solve_field(box(2, 2, 2), nothing, nothing)
    with pytest.raises(ValueError, match="empty"):
        solve_field(VoxelGrid(np.zeros(3), 1.0, np.zeros((2, 2, 2), bool)), nothing, nothing)


@pytest.mark.parametrize("open_below", [False, True])
def test_inside_of_a_mesh_even_when_it_is_open(open_below: bool) -> None:
    spacing = 5e-3
    grid = VoxelGrid(np.full(3, -0.1), spacing, np.ones((41, 41, 41), bool))
    inside = inside_mesh(grid, ball_mesh(0.08, open_below=open_below))
    index = np.argwhere(np.ones_like(inside))
    centers = grid.centers(index)
    radius = np.linalg.norm(centers, axis=1)
    clear = centers[:, 2] > (-0.05 if open_below else -1)
    assert inside.ravel()[(radius < 0.077) & clear].mean() > 0.999
    assert inside.ravel()[radius > 0.081].mean() < 0.001


def test_surface_samples_are_on_the_surface_and_dense() -> None:
    from scipy.spatial import cKDTree

    points, normals, faces = surface_samples(ball_mesh(0.1), 4e-3)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.1, rtol=0.01)
    assert (normals * points).sum(axis=1).min() > 0.098
    assert cKDTree(points).query(points, k=2)[0][:, 1].max() < 4e-3
    assert faces.max() < len(ball_mesh(0.1).faces)


def test_carving_empties_what_a_camera_saw_through() -> None:
    camera = Camera.look_at("c", 40, 40, (0, -1.0, 0), (0, 0, 0), 20.0)
    grid = VoxelGrid(np.full(3, -0.05), 5e-3, np.ones((21, 21, 21), bool))
    carved = space_carve(grid, [camera], {"c": np.full((40, 40), 1.0)}, margin=1e-3)
    y = carved.centers()[:, 1]
    assert y.min() == pytest.approx(0)
    assert len(y) == 21 * 21 * 11
    assert not space_carve(grid, [camera], {"c": np.full((40, 40), np.inf)}).inside.any()
    assert space_carve(grid, [camera], {"c": np.zeros((40, 40))}).inside.all()
    with pytest.raises(ValueError, match="first_surface must be"):
        space_carve(grid, [camera], {"c": np.zeros((4, 4))})


def test_depth_maps() -> None:
    camera = Camera.look_at("c", 40, 40, (0, -1.0, 0), (0, 0, 0), 20.0)
    depth = mesh_depth(camera, ball_mesh(0.1))
    assert depth[20, 20] == pytest.approx(0.9, abs=1e-3)
    assert np.isinf(depth[0, 0])
    x = np.array([[0, 0.1, 0], [0, -0.2, 0], [0, 0.3, 0]])
    assert depth_map(camera, x)[20, 20] == pytest.approx(1.1)  # the median of three
    assert depth_map(camera, x[:2])[20, 20] == pytest.approx(0.8)  # the nearer of two
    assert depth_map(camera, x)[0, 0] == 0
