"""The generic head is laid under points of another head."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from reconstruction import Mesh, read_obj
from reconstruction.geometry.closest_point import ClosestPoint, closest_on_triangles
from reconstruction.geometry.mesh_queries import surface_samples
from reconstruction.head.fit import (
    HeadFit,
    HeadFitError,
    HeadHints,
    Part,
    fit_head,
    mark_scalp,
)
from reconstruction.head.generic import generic_head
from reconstruction.head.pose import similarity
from reconstruction.head.scalp_map import ScalpMap

TURN = Rotation.from_rotvec([0.1, -0.1, -1.9]).as_matrix()
SHIFT = np.array([0.02, 0.01, 0.1])


def another_head() -> Mesh:
    """The generic head with another shape, 5 % larger, turned by 109 degrees and moved."""
    x, y, z = (v := generic_head().vertices).T
    bent = [x * (1 + 0.08 * np.sin(10 * z)), 1.05 * y, z + 0.006 * np.sin(20 * x + 15 * y)]
    mesh = Mesh(1.05 * np.stack(bent, axis=1), generic_head().faces, generic_head().scalp)
    assert np.ptp(v) > 0.2
    return mesh.transformed(TURN, SHIFT)


def observed(
    where: Callable[[np.ndarray, np.ndarray], np.ndarray], count: int, outliers: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Points with 1 mm of noise and normals where `where(points, on_scalp)`, in the head's frame.

    Outliers fill a box of half a metre.
    """
    rng = np.random.default_rng(0)
    p, n, face = surface_samples(another_head(), 4e-3)
    scalp = generic_head().scalp
    assert scalp is not None
    chosen = np.flatnonzero(where((p - SHIFT) @ TURN, scalp[face]))
    chosen = rng.permutation(chosen)[:count]
    wrong = int(outliers * len(chosen) / (1 - outliers))
    away = rng.standard_normal((wrong, 3))
    points = p[chosen] + 1e-3 * rng.standard_normal((len(chosen), 3))
    return (
        np.vstack([points, SHIFT + rng.uniform(-0.25, 0.25, (wrong, 3))]),
        np.vstack([n[chosen], away / np.linalg.norm(away, axis=1, keepdims=True)]),
    )


def everywhere(p: np.ndarray, scalp: np.ndarray) -> np.ndarray:
    return np.ones(len(p), bool)


def crown(p: np.ndarray, scalp: np.ndarray) -> np.ndarray:
    return p[:, 2] > 0.1


def off_the_true_scalp(mesh: Mesh) -> np.ndarray:
    """Distances in millimetres of the true scalp's vertices from `mesh`."""
    truth = another_head()
    vertices = truth.vertices[np.unique(truth.faces[truth.scalp])]
    return 1e3 * ClosestPoint(mesh, 8e-3)(vertices)[2]


def posed(fit: HeadFit) -> Mesh:
    return Mesh(fit.pose(generic_head().vertices), generic_head().faces)


@pytest.mark.parametrize(
    ("where", "part", "outliers", "normals", "median"),
    [
        pytest.param(everywhere, "head", 0.0, True, 0.3, marks=pytest.mark.slow),
        (everywhere, "head", 0.3, False, 0.4),
        pytest.param(lambda p, scalp: scalp, "scalp", 0.3, True, 0.3, marks=pytest.mark.slow),
        pytest.param(lambda p, scalp: p[:, 0] > 0, "head", 0.0, True, 0.6, marks=pytest.mark.slow),
        (lambda p, scalp: ~scalp & (p[:, 2] > -0.12), "head", 0.0, True, 4.0),
    ],
    ids=["all", "30 % outliers, no normals", "scalp, 30 % outliers", "one side", "bare skin"],
)
def test_the_scalp_is_found_from(where, part, outliers, normals, median) -> None:  # type: ignore[no-untyped-def]
    points, facing = observed(where, 2000, outliers)
    fit = fit_head(points, facing if normals else None, hints=HeadHints(part=part))
    assert fit.pose.scale == pytest.approx(1.06, abs=0.05)
    off = off_the_true_scalp(fit.mesh)
    assert np.median(off) < median
    assert np.median(off) < 0.6 * np.median(off_the_true_scalp(posed(fit)))
    assert fit.deformed.to_mesh_median < fit.posed.to_mesh_median
    assert fit.deformed.to_points_median < 0.01
    assert fit.outliers.mean() == pytest.approx(outliers, abs=0.06)
    assert fit.warnings == ()
    json.dumps(fit.figures(), allow_nan=False)


def test_few_points_give_a_pose() -> None:
    points, normals = observed(everywhere, 30)
    fit = fit_head(points, normals)
    assert np.percentile(off_the_true_scalp(fit.mesh), 95) < 12
    assert fit.deformed.to_points_median > 0.02  # and it shows that most of the head was not seen


@pytest.mark.parametrize("part", ["head", pytest.param("scalp", marks=pytest.mark.slow)])
def test_inward_normals_raise_an_error(part: Part) -> None:
    """As of scanners and meshes that are inside out; the head came out centimetres off."""
    head = generic_head()
    places, normals, face = surface_samples(head, 6e-3)
    on = head.scalp[face] if part == "scalp" else np.ones(len(face), bool)
    points, outward = 1.03 * places[on][::12] + [0.01, 0.02, 0.03], normals[on][::12]
    hints = HeadHints(part=part)
    assert not fit_head(points, outward, hints=hints).warnings
    with pytest.raises(HeadFitError, match="the normals point into the head: reverse them"):
        fit_head(points, -outward, hints=hints)


def test_an_inverted_mesh_raises_an_error() -> None:
    head = generic_head()
    with pytest.raises(HeadFitError, match=r"reverse them \(for a mesh, its faces\)"):
        mark_scalp(Mesh(100 * head.vertices, head.faces[:, ::-1]))


def test_a_crown_without_landmarks_is_reported_as_ambiguous() -> None:
    points, normals = observed(crown, 500)
    fit = fit_head(points, normals, hints=HeadHints(part="scalp"))
    assert any("hardly determine" in w for w in fit.warnings)
    assert any("provide landmarks" in w for w in fit.warnings)
    vertices = generic_head().vertices[::1500]
    known = another_head().vertices[::1500]
    fit = fit_head(points, normals, hints=HeadHints(part="scalp", landmarks=(vertices, known)))
    assert not any("provide landmarks" in w for w in fit.warnings)
    assert np.degrees(Rotation.from_matrix(fit.pose.rotation @ TURN.T).magnitude()) < 15


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1000, "in millimetres; multiply them by 0.001"),
        (100, "in centimetres; multiply them by 0.01"),
        (10, "in decimetres; multiply them by 0.1"),
        (0.1, r"extent is only 0\.1\d* times"),
        (0.6, "times the template's size"),
    ],
)
def test_wrong_unit_raises_an_error(factor: float, words: str) -> None:
    points, normals = observed(everywhere, 300)
    with pytest.raises(HeadFitError, match=words):
        fit_head(factor * points, normals)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.zeros((0, 3)), "0 points, at least 10"),
        (np.ones((9, 3)), "9 points, at least 10"),
        (np.ones((20, 3)), "coincide or are collinear"),
        (np.linspace(0, 0.2, 60).reshape(20, 3) * [1, 0, 0], "coincide or are collinear"),
        (np.full((20, 3), np.nan), "20 points are not finite, the first is number 0"),
    ],
)
def test_points_that_are_no_head_are_errors(points: np.ndarray, words: str) -> None:
    with pytest.raises(HeadFitError, match=words):
        fit_head(points)


def test_invalid_arguments_raise_errors() -> None:
    points, normals = observed(everywhere, 50)
    bare = Mesh(generic_head().vertices, generic_head().faces)
    with pytest.raises(HeadFitError, match="marks no scalp"):
        fit_head(points, template=bare, hints=HeadHints(part="scalp"))
    with pytest.raises(HeadFitError, match="50 points but 49 normals"):
        fit_head(points, normals[1:])
    with pytest.raises(HeadFitError, match="at least 3 pairs of landmarks"):
        fit_head(points, hints=HeadHints(landmarks=(points[:2], points[:2])))
    with pytest.raises(HeadFitError, match="are collinear"):
        fit_head(points, hints=HeadHints(landmarks=(np.eye(3) * [1, 0, 0], np.eye(3) * [1, 0, 0])))
    with pytest.raises(ValueError, match="part must be"):
        fit_head(points, hints=HeadHints(part="nose"))  # type: ignore[arg-type]


@given(st.integers(0, 1000), st.floats(1e-3, 1e3))
def test_similarities_are_recovered(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    source, shift = rng.standard_normal((4, 3)), rng.standard_normal(3)
    turn = Rotation.random(random_state=seed).as_matrix()
    found = similarity(source, scale * source @ turn.T + shift)
    assert found[0] == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(found[1], turn, atol=1e-7)
    np.testing.assert_allclose(found[2], shift, atol=1e-8 * max(scale, 1))


@settings(max_examples=50)
@given(st.integers(0, 10_000), st.booleans())
def test_the_closest_point_of_a_triangle(seed: int, flat: bool) -> None:
    """No point of a fine net over the triangle is closer, also where the triangle is a line."""
    rng = np.random.default_rng(seed)
    corners, point = rng.standard_normal((3, 3)), 2 * rng.standard_normal(3)
    if flat:
        corners[2] = 0.5 * (corners[0] + corners[1])
    weights = closest_on_triangles(point, corners)
    assert weights.min() >= 0
    assert weights.sum() == pytest.approx(1)
    i, j = (a.ravel() for a in np.meshgrid(*[np.arange(41)] * 2, indexing="ij"))
    i, j = i[i + j <= 40] / 40, j[i + j <= 40] / 40
    net = np.stack([1 - i - j, i, j], axis=1) @ corners
    nearest = np.linalg.norm(net - point, axis=1).min()
    assert np.linalg.norm(weights @ corners - point) <= nearest + 1e-9


def test_the_closest_point_of_no_faces_is_an_error() -> None:
    head = generic_head()
    with pytest.raises(ValueError, match="no faces"):
        ClosestPoint(head, 0.01, np.zeros(len(head.faces), bool))


def the_head_in(path: Path, above: float) -> Mesh:
    """The largest piece of an OBJ with y up, turned to z up, its faces above a height."""
    mesh = read_obj(path).transformed(np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]), np.zeros(3))
    a, b, c = mesh.faces.T
    size = (len(mesh.vertices),) * 2
    links = coo_array((np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, c])), shape=size)
    _, piece = connected_components(links, directed=False)
    keep = piece[a] == np.bincount(piece).argmax()
    keep &= (mesh.vertices[mesh.faces][:, :, 2] > above).all(axis=1)
    used, faces = np.unique(mesh.faces[keep], return_inverse=True)
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "above", "scale"),
    [("lee_perry_smith.obj", -1.0, 1.14), ("makehuman_base.obj", 6.0, 10.2)],
)
def test_the_scalp_is_marked_on_other_heads_of_any_unit(
    file: str, above: float, scale: float, shared_data: Callable[[str], Path]
) -> None:
    head = the_head_in(shared_data("heads") / file, above)
    marked, fit = mark_scalp(head)
    assert fit.pose.scale == pytest.approx(scale, rel=0.02)
    assert fit.deformed.to_mesh_median < 1e-3 * scale < fit.posed.to_mesh_median
    assert marked.scalp is not None
    own, generic = marked.face_areas()[marked.scalp].sum(), generic_head()
    assert own / scale**2 == pytest.approx(generic.face_areas()[generic.scalp].sum(), rel=0.15)
    assert ScalpMap.of(marked).stretch().min() > 0.3
    points, normals, _ = surface_samples(marked, 0.02 * scale)
    here = marked.vertices[::500]  # and then it is a template like any other
    again = fit_head(
        1.02 * points, normals, marked, hints=HeadHints(landmarks=(here, here), any_unit=True)
    )
    assert again.pose.scale == pytest.approx(1.02, rel=1e-3)
