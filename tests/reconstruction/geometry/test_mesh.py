"""Triangle meshes and Wavefront OBJ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from reconstruction import Mesh, read_obj, write_obj

TETRAHEDRON = Mesh(
    np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)


@st.composite
def meshes(draw: st.DrawFn) -> Mesh:
    count = draw(st.integers(3, 9))
    vertices = draw(hnp.arrays(np.float64, (count, 3), elements=st.floats(-9, 9, width=32)))
    faces = draw(hnp.arrays(np.int64, (draw(st.integers(1, 6)), 3), elements=st.integers(0, 2)))
    scalp = draw(st.none() | hnp.arrays(bool, len(faces)))
    return Mesh(vertices, faces, scalp)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=50)
@given(mesh=meshes())
def test_read_back(mesh: Mesh, tmp_path: Path) -> None:
    write_obj(tmp_path / "m.obj", mesh)
    again = read_obj(tmp_path / "m.obj")
    np.testing.assert_allclose(again.vertices, mesh.vertices, rtol=1e-8)
    scalp = mesh.scalp if mesh.scalp is not None else np.zeros(len(mesh.faces), bool)
    order = np.concatenate([np.flatnonzero(~scalp), np.flatnonzero(scalp)])
    np.testing.assert_array_equal(again.faces, mesh.faces[order])
    if scalp.any():
        np.testing.assert_array_equal(again.scalp, scalp[order])
    else:
        assert again.scalp is None


def test_normals_and_areas() -> None:
    normals = TETRAHEDRON.face_normals()
    expected = [[0, 0, -1], [0, -1, 0], [-1, 0, 0], np.ones(3) / np.sqrt(3)]
    np.testing.assert_allclose(normals, expected, atol=1e-12)
    np.testing.assert_allclose(TETRAHEDRON.face_areas(), [0.5, 0.5, 0.5, np.sqrt(3) / 2])
    corner = TETRAHEDRON.vertex_normals()[0]
    np.testing.assert_allclose(corner, -np.ones(3) / np.sqrt(3), atol=1e-12)


def test_nothing_has_no_normal() -> None:
    flat = Mesh(np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 5, 5]]), np.array([[0, 1, 2]]))
    assert not flat.face_normals().any()
    assert not flat.vertex_normals().any()
    assert flat.face_areas().tolist() == [0]


def test_moving_turns_the_normals() -> None:
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = TETRAHEDRON.transformed(turn, [1, 2, 3])
    np.testing.assert_allclose(moved.face_normals(), TETRAHEDRON.face_normals() @ turn.T)
    assert moved.vertices[0].tolist() == [1, 2, 3]


def test_polygons_slashes_and_negative_indices(tmp_path: Path) -> None:
    path = tmp_path / "m.obj"
    path.write_text(
        "# a square and a triangle\nv 0 0 0 1 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\n"
        "usemtl Skin\nf 1/1/1 2/1/1 3//1 4\nusemtl Scalp_hair\nf -4 -3 -2\n"
    )
    mesh = read_obj(path)
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]
    assert mesh.scalp is not None
    assert mesh.scalp.tolist() == [False, False, True]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("v 0 0 0\n", r"m\.obj: no faces"),
        ("v 0 0 zero\n", r"m\.obj, line 1: "),
        ("v 0 0 0\nv 1 0 0\nf 1 2 x\n", r"m\.obj, line 3: "),
        ("v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 4\n", r"m\.obj.*index the 3 vertices"),
        (f"v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 {10**20}\n", r"m\.obj.*index the 3 vertices"),
        ("v 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n", r"m\.obj, line 1: "),
    ],
)
def test_broken_files_are_named(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "m.obj").write_text(text)
    with pytest.raises(ValueError, match=words):
        read_obj(tmp_path / "m.obj")


@pytest.mark.parametrize(
    ("vertices", "faces", "scalp", "words"),
    [
        (np.zeros((3, 3)), [[0, 1, 3]], None, "index the 3 vertices"),
        (np.full((3, 3), np.inf), [[0, 1, 2]], None, "must be finite"),
        (np.zeros((3, 3)), [[0, 1, 2]], [True, False], "scalp must mark the 1 faces"),
    ],
)
def test_bad_meshes(
    vertices: np.ndarray, faces: list[list[int]], scalp: list[bool] | None, words: str
) -> None:
    marks = None if scalp is None else np.array(scalp)
    with pytest.raises(ValueError, match=words):
        Mesh(vertices, np.array(faces), marks)
