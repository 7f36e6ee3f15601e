"""The user's head mesh as a template: z up, metres, scalp marked."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from reconstruction.arrays import Bools
from reconstruction.geometry.mesh import Mesh
from reconstruction.head.fit import HeadFit, HeadFitError, mark_scalp

Axis = Literal["y", "z"]

_TURNS = {"z": np.eye(3), "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])}


def template(
    mesh: Mesh, *, up: Axis = "z", above: float | None = None, seed: int = 0
) -> tuple[Mesh, HeadFit | None]:
    """`mesh` as a template: z up, face towards −y, metres, scalp marked.

    `up` is the mesh's up axis; faces not entirely above the height `above` (in the mesh's unit) are
    removed, for a body below the neck. A mesh with a marked scalp must be in metres and is only
    rotated. Of any other mesh, in any unit and direction, the largest connected part is kept, its
    scalp is marked by fitting the generic head, and it is moved into the generic head's frame; that
    fit is returned as well. Raises `HeadFitError`.
    """
    mesh = mesh.transformed(_TURNS[up], np.zeros(3))
    if above is not None:
        keep = np.asarray(mesh.vertices[mesh.faces][:, :, 2] > above)
        mesh = _faces_only(mesh, np.asarray(keep.all(axis=1)))
        if not len(mesh.faces):
            raise HeadFitError(f"no face of the mesh is entirely above {above:g}")
    if mesh.scalp is not None:
        return mesh, None
    marked, fit = mark_scalp(_largest_piece(mesh), seed=seed)
    assert marked.scalp is not None
    if not marked.scalp.any():
        raise HeadFitError("no scalp was found: check that the mesh is a head and its up axis")
    return Mesh(fit.pose.inverse(marked.vertices), marked.faces, marked.scalp), fit


def _largest_piece(mesh: Mesh) -> Mesh:
    a, b, c = mesh.faces.T
    links = coo_array(
        (np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, c])), shape=(len(mesh.vertices),) * 2
    )
    piece = connected_components(links, directed=False)[1][a]
    return _faces_only(mesh, piece == np.bincount(piece).argmax())


def _faces_only(mesh: Mesh, keep: Bools) -> Mesh:
    """The mesh of some faces, without unused vertices."""
    used, faces = np.unique(mesh.faces[keep], return_inverse=True)
    scalp = None if mesh.scalp is None else mesh.scalp[keep]
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3), scalp)
