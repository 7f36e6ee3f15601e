"""The scalp map: from roots to (u, v) in the unit square, for appearance volumes.

Lambert's equal-area projection of the scalp from the centre of its best-fitting sphere, scaled to
the unit square: u grows to the subject's left, v from the forehead to the nape. Heads of one
template share the map by vertex.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from reconstruction.arrays import AnyFloats, Array, Bools
from reconstruction.geometry.closest_point import ClosestPoint
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.strands import Strands
from reconstruction.head.scalp import Scalp
from reconstruction.model import Model
from reconstruction.report.report import Stage

_SPACING = 2e-2  # of samples for the closest point, as a share of the scalp's extent


@dataclass(frozen=True, eq=False)
class ScalpMap:
    """`uv (V, 2)` at the vertices of scalp faces of `head`; NaN at the others."""

    head: Mesh
    uv: Array
    _closest: ClosestPoint = field(init=False)

    def __post_init__(self) -> None:
        scalp = _scalp(self.head)
        if self.uv.shape != (len(self.head.vertices), 2):
            raise ValueError(
                f"expected uv for {len(self.head.vertices)} vertices, got {self.uv.shape}"
            )
        extent = float(np.ptp(self.head.vertices[self.head.faces[scalp]], axis=(0, 1)).max())
        object.__setattr__(self, "_closest", ClosestPoint(self.head, _SPACING * extent, scalp))

    @classmethod
    def of(cls, head: Mesh) -> ScalpMap:
        """The map of a head with marked scalp, z up and face towards −y.

        Raises `ValueError` without a marked scalp, or if the map folds: if a ray from the centre
        meets the scalp twice.
        """
        scalp = _scalp(head)
        faces = head.faces[scalp]
        used, areas = np.unique(faces), head.face_areas()[scalp]
        d = head.vertices[used] - sphere_center(head.vertices[used])
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        weight = np.bincount(faces.ravel(), np.repeat(areas, 3))[used]
        pole = weight @ d
        pole /= np.linalg.norm(pole)
        right = np.array([1.0, 0, 0]) - pole[0] * pole
        right /= np.linalg.norm(right)
        back = np.cross(pole, right)
        flat = np.stack([d @ right, d @ back], axis=1)
        flat *= np.sqrt(2 / np.maximum(1 + d @ pole, 1e-9))[:, None]
        uv = np.full((len(head.vertices), 2), np.nan)
        uv[used] = (flat - flat.min(axis=0)) / np.ptp(flat, axis=0)
        folded = int(((_signed_areas(uv[faces]) <= 0) & (areas > 1e-9 * areas.max())).sum())
        if folded:
            raise ValueError(
                f"the map of the scalp folds at {folded} of its {len(faces)} faces: they face the "
                "centre of the head or overlap (ears?); remove them from the marked scalp"
            )
        return cls(head, uv)

    def on(self, head: Mesh) -> ScalpMap:
        """The same map on `head`, another shape or pose of the template."""
        if not np.array_equal(head.faces, self.head.faces):
            raise ValueError("both heads must have the same faces")
        return ScalpMap(Mesh(head.vertices, head.faces, self.head.scalp), self.uv)

    def __call__(self, points: AnyFloats) -> tuple[Array, Array]:
        """(u, v) `(N, 2)` of the scalp points closest to `points (N, 3)`, and the distances."""
        face, weights, distance = self._closest(points)
        uv = np.einsum("nc,ncd->nd", weights, self.uv[self.head.faces[face]])
        return np.clip(uv, 0, 1), distance

    def stretch(self) -> Array:
        """Area on the map over area on the head, by scalp face, in units of their mean `(F,)`."""
        scalp = _scalp(self.head)
        areas = self.head.face_areas()[scalp]
        ratio = _signed_areas(self.uv[self.head.faces[scalp]]) / np.maximum(areas, 1e-300)
        return np.asarray(ratio / np.average(ratio, weights=areas))


def _scalp(head: Mesh) -> Bools:
    if head.scalp is None or not head.scalp.any():
        raise ValueError(
            "the head marks no scalp: mark it in the OBJ or with 'hairstage head mark'"
        )
    return head.scalp


def sphere_center(points: Array) -> Array:
    """Centre `(3,)` of the sphere fitted to `points (N, 3)` by algebraic least squares."""
    middle = points.mean(axis=0)
    q = points - middle
    solved, *_ = np.linalg.lstsq(np.c_[2 * q, np.ones(len(q))], (q**2).sum(axis=1), rcond=None)
    return np.asarray(middle + solved[:3])


def _signed_areas(corners: Array) -> Array:
    """Areas of flat triangles `(F, 3, 2)`, negative if reversed."""
    e, f = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.asarray(0.5 * (e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]))


def write_root_map(
    model: Model, strands: Strands, scalp: Scalp, flat: ScalpMap | None, stage: Stage
) -> None:
    """Write `scalp_map.npz` into `model`: the (u, v) of every root, and the map of the scalp.

    roots (S, 2) float32     of each strand, in the order of `strands.npz`
    uv (V, 2) float32        at the scalp's `vertices (V, 3)` with `faces (F, 3)`

    `flat` is the map of the head's template; without one, the head must have z up and face −y. If
    the map folds, no file is written and the stage warns.
    """
    if flat is None:
        marked = scalp.head.scalp if scalp.marked else scalp.share >= 0.5
        try:
            flat = ScalpMap.of(Mesh(scalp.head.vertices, scalp.head.faces, marked))
        except ValueError as error:
            model.remove("scalp_map.npz")
            stage.warn(f"no scalp_map.npz: {error}")
            return
    uv, distance = flat(strands.roots)
    used, faces = np.unique(flat.head.faces[flat.head.scalp], return_inverse=True)
    model.write_arrays(
        "scalp_map.npz",
        {
            "roots": uv.astype(np.float32),
            "uv": flat.uv[used].astype(np.float32),
            "vertices": flat.head.vertices[used],
            "faces": faces.reshape(-1, 3),
        },
    )
    stage.figures["roots_off_the_map_mm"] = float(distance.max(initial=0.0) * 1e3)
