"""Triangle meshes: the head under the hair."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reconstruction.arrays import Array, Bools, Ints
from reconstruction.containment import plain_file
from reconstruction.geometry.strands import unit_or_zero

LONGEST_LINE = 1 << 16
"""Characters of an OBJ file's line: a polygon of some thousand corners."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh: `vertices (V, 3) float64` in metres, `faces (F, 3) int64`.

    `scalp (F,) bool` marks the faces that hair grows from; None if unknown.
    """

    vertices: Array
    faces: Ints
    scalp: Bools | None = None

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.ascontiguousarray(self.faces, dtype=np.int64).reshape(-1, 3)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
        if not np.isfinite(vertices).all():
            raise ValueError("mesh vertices must be finite")
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise ValueError(f"mesh faces must index the {len(vertices)} vertices")
        if self.scalp is not None and np.shape(self.scalp) != (len(faces),):
            raise ValueError(f"scalp must mark the {len(faces)} faces, got {np.shape(self.scalp)}")

    def face_normals(self) -> Array:
        """Unit normals `(F, 3)` by the right-hand rule; 0 for faces without area."""
        return unit_or_zero(self._cross())

    def face_areas(self) -> Array:
        """Areas `(F,)` in square metres."""
        return 0.5 * np.linalg.norm(self._cross(), axis=1)

    def vertex_normals(self) -> Array:
        """Area-weighted unit normals `(V, 3)`; 0 for vertices of no face."""
        n = np.zeros_like(self.vertices)
        np.add.at(n, self.faces.ravel(), np.repeat(self._cross(), 3, axis=0))
        return unit_or_zero(n)

    def transformed(self, rotation: ArrayLike, translation: ArrayLike) -> Mesh:
        """The mesh moved by `x -> rotation (3, 3) @ x + translation (3,)`."""
        moved = self.vertices @ np.asarray(rotation, float).T + np.asarray(translation, float)
        return Mesh(moved, self.faces, self.scalp)

    def _cross(self) -> Array:
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return np.cross(b - a, c - a)


def read_obj(path: str | Path, most: int | None = None) -> Mesh:
    """Read the triangles of a Wavefront OBJ; polygons are fanned.

    Faces in a group, object or material whose name contains "scalp" are marked as scalp; without
    such a name `scalp` is None. Raises `OSError`, and `ValueError` naming the file if it has no
    triangles or more than `most`, is no text, no regular file or larger than 256 MiB.
    """
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    scalp: list[bool] = []
    in_scalp = {"g": False, "o": False, "usemtl": False}
    for number, line in _lines(plain_file(path)):
        words = line.split()
        if not words:
            continue
        try:
            if words[0] == "v":
                x, y, z = (float(w) for w in words[1:4])
                vertices.append([x, y, z])
            elif words[0] == "f":
                index = [int(w.split("/")[0]) for w in words[1:]]
                index = [i - 1 if i > 0 else len(vertices) + i for i in index]
                for k in range(1, len(index) - 1):
                    faces.append([index[0], index[k], index[k + 1]])
                    scalp.append(any(in_scalp.values()))
            elif words[0] in in_scalp:
                in_scalp[words[0]] = "scalp" in " ".join(words[1:]).lower()
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: {error}") from error
        if most is not None and max(len(faces), len(vertices)) > most:
            raise ValueError(
                f"{path}: more than {most:,} triangles or vertices; at most so many are read: "
                "make the mesh coarser"
            )
    if not faces:
        raise ValueError(f"{path}: no faces; expected a triangle mesh in Wavefront OBJ")
    try:
        return Mesh(np.array(vertices), np.array(faces), np.array(scalp) if any(scalp) else None)
    except OverflowError:  # an index beyond 64 bits
        raise ValueError(f"{path}: mesh faces must index the {len(vertices)} vertices") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """The lines of a text and their numbers. Raises `ValueError` naming the file."""
    number = 0
    with path.open() as file:
        try:
            while line := file.readline(LONGEST_LINE + 1):
                number += 1
                if len(line) > LONGEST_LINE and line.startswith("#"):
                    while line and not line.endswith("\n"):
                        line = file.readline(LONGEST_LINE)
                elif len(line) > LONGEST_LINE:
                    raise ValueError(
                        f"{path}, line {number}: more than {LONGEST_LINE:,} characters; a face has "
                        "a few corners"
                    )
                else:
                    yield number, line
        except UnicodeDecodeError as error:
            raise ValueError(f"{path} is no Wavefront OBJ: {error}") from error


def write_obj(path: str | Path, mesh: Mesh) -> None:
    """Write a Wavefront OBJ; marked scalp faces go into a group called `scalp`."""
    scalp = mesh.scalp if mesh.scalp is not None else np.zeros(len(mesh.faces), bool)
    with Path(path).open("w") as file:
        for block in _blocks(mesh.vertices):
            file.writelines(f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in block)
        for name, which in (("head", ~scalp), ("scalp", scalp)):
            if which.any():
                file.write(f"g {name}\n")
                for block in _blocks(mesh.faces[which] + 1):
                    file.writelines(f"f {a} {b} {c}\n" for a, b, c in block)


def _blocks(rows: NDArray[Any]) -> Iterator[list[Any]]:
    """Rows as Python numbers, 65,536 at a time to bound memory."""
    return (rows[i : i + 65536].tolist() for i in range(0, len(rows), 65536))
