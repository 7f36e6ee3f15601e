"""Points of digitisers and scanners, in four formats."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from reconstruction.files.points import read_points

POINTS = np.array([[0.1, -0.2, 0.3], [1.5, 2.5, -3.5]])
NORMALS = np.array([[0, 0, 1.0], [0.6, 0.8, 0]])
PLY = """ply
format {form} 1.0
comment from a scanner
element vertex 2
property float x
property float y
property float z
property uchar red
property float nx
property float ny
property float nz
element face 1
property list uchar int vertex_indices
end_header
"""


def ply(form: str) -> bytes:
    rows = np.zeros(2, [("p", "<f4", 3), ("red", "u1"), ("n", "<f4", 3)])
    rows["p"], rows["red"], rows["n"] = POINTS, 7, NORMALS
    if form == "ascii":
        lines = [" ".join(map(str, [*p, 7, *n])) for p, n in zip(POINTS, NORMALS, strict=True)]
        body = ("\n".join(lines) + "\n3 0 1 0\n").encode()
    elif form == "binary_big_endian":
        big = np.dtype([("p", ">f4", 3), ("red", "u1"), ("n", ">f4", 3)])
        body = rows.astype(big).tobytes() + b"\x03"
    else:
        body = rows.tobytes() + b"\x03"
    return PLY.format(form=form).encode() + body


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.ply", ply("ascii")),
        ("b.ply", ply("binary_little_endian")),
        ("c.PLY", ply("binary_big_endian")),
        ("d.obj", b"v .1 -.2 .3\nv 1.5 2.5 -3.5\nvn 0 0 2\nvn .6 .8 0\nf 1 2 1\n"),
        ("e.csv", b"x,y,z,nx,ny,nz\n.1, -.2, .3, 0, 0, 1\n# a comment\n1.5,2.5,-3.5,.6,.8,0\n"),
        ("f.csv", b".1 -.2 .3 0 0 1\n\n1.5;2.5;-3.5;0.6;0.8;0\n"),
        ("g.csv", b"\xef\xbb\xbf.1,-.2,.3,0,0,1\n1.5,2.5,-3.5,.6,.8,0\n"),  # of a spreadsheet,
        ("h.csv", b"x;y;z;a;b;c\n0,1;-0,2;0,3;0;0;1\n1,5;2,5;-3,5;0,6;0,8;0\n"),  # in German
    ],
)
def test_points_and_normals_are_read(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    points, normals = read_points(tmp_path / name)
    np.testing.assert_allclose(points, POINTS, atol=1e-6)
    assert normals is not None
    np.testing.assert_allclose(normals, NORMALS, atol=1e-6)


def test_points_without_normals_are_read(tmp_path: Path) -> None:
    np.save(tmp_path / "p.npy", POINTS)
    points, normals = read_points(tmp_path / "p.npy")
    np.testing.assert_array_equal(points, POINTS)
    assert normals is None


def test_three_numbers_with_decimal_commas_are_no_point_with_a_normal(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("0,1;-0,2;0,3\n1,5;2,5;-3,5\n")
    points, normals = read_points(tmp_path / "p.csv")
    np.testing.assert_allclose(points, POINTS)
    assert normals is None


def npy(shape: tuple[int, int]) -> bytes:
    """Twelve numbers under a header of `shape`."""
    file = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue() + bytes(8 * 12)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.txt", b"", r"a\.txt: expected a file of points"),
        ("a.csv", b"", r"a\.csv: expected \(N, 3\)"),
        ("a.csv", b"1,2,3\n1,2\n", "line 2: 2 numbers, expected 3"),
        ("a.csv", b"1,2,3\n1,b,3\n", "line 2: expected numbers"),
        ("a.csv", b"1,2,nan\n", "point 0 is not finite"),
        ("a.obj", b"f 1 2 3\n", r"a\.obj: expected \(N, 3\)"),
        ("a.ply", b"solid\n", "no PLY header"),
        ("a.ply", ply("binary_little_endian")[:-40], r"bytes for 2 x vertex of 25"),
        ("a.ply", ply("ascii")[:-40], "numbers for 2 x vertex of 7"),
        ("a.ply", ply("ascii").replace(b" z", b" w"), "expected x, y and z"),
        ("a.ply", ply("ascii").replace(b"ascii", b"gzip"), "format 'gzip'"),
        ("a.npy", b"no array", r"a\.npy: "),
        ("a.npy", npy((4, 3))[:-8], "truncated, 88 of 96 bytes"),
        ("a.npy", npy((450_000_000, 3)), "needs 10800000000 bytes, the file has"),
    ],
)
def test_invalid_point_files_raise_errors_that_name_the_problem(
    tmp_path: Path, name: str, content: bytes, words: str
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=words):
        read_points(tmp_path / name)
