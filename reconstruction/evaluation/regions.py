"""Parts of a head of hair: by the scalp that it grows from, and by depth below its surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from reconstruction.arrays import AnyFloats, Array, Ints
from reconstruction.evaluation.oriented_points import OrientedPoints
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_queries import inside_mesh
from reconstruction.geometry.strands import Strands
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.head.scalp_map import sphere_center

SCALP = ("front", "top", "sides", "back", "nape")
DEPTHS = ("outer", "inner")
INNER = 5e-3  # metres below the hair's surface where the inner hair begins
_VOXEL = 2e-3
MOST_VOXELS = 8_000_000
_CLOSED = 2.5
"""Voxels by which the hair is grown and shrunk again: gaps under twice that are no surface."""

_FEWEST_ROOTS = 10
_UNEVEN = 0.25
"""A scalp's roots lie this close to a sphere, as a share of its radius, root mean square."""


@dataclass(frozen=True, eq=False)
class HeadSphere:
    """The sphere `center (3,)`, `radius` that fits the roots of a head of hair best."""

    center: Array
    radius: float

    @classmethod
    def of(cls, strands: Strands) -> HeadSphere | None:
        """None where the roots lie on nothing like a head."""
        roots = strands.roots.astype(float)
        if len(roots) < _FEWEST_ROOTS:
            return None
        center = sphere_center(roots)
        distance = np.linalg.norm(roots - center, axis=1)
        radius = float(distance.mean())
        extent = float(np.ptp(roots, axis=0).max())
        if distance.std() > _UNEVEN * radius or not 0 < radius < extent:
            return None
        return cls(center, radius)

    def scalp_regions(self, roots: AnyFloats) -> Ints:
        """Indices into `SCALP (N,)` of `roots (N, 3)`: z is up and the face looks towards -y.

        Seen from the centre: what rises over 50° is top, the rest in quarters of 90° to the front,
        the sides and the back; below the centre the back is the nape.
        """
        x, y, z = ((roots - self.center) / self.radius).T
        steep = z > np.tan(np.radians(50)) * np.hypot(x, y)
        ahead = np.where(y < 0, SCALP.index("front"), SCALP.index("back"))
        around = np.where(np.abs(x) > np.abs(y), SCALP.index("sides"), ahead)
        around = np.where((around == SCALP.index("back")) & (z < 0), SCALP.index("nape"), around)
        return np.asarray(np.where(steep, SCALP.index("top"), around))


class HairDepth:
    """How deep points lie in the true hair, head included, whose outside is its surface.

    What is within 5 mm of the hair's points belongs to it as far as it is closed off from outside
    by them: gaps under 1 cm are closed. `head` is the mesh where there is one, or else a sphere a
    little inside its roots.
    """

    def __init__(self, truth: OrientedPoints, head: Mesh | HeadSphere | None) -> None:
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for block in truth.blocks():
            low = np.minimum(low, block.points.min(axis=0))
            high = np.maximum(high, block.points.max(axis=0))
        margin = int(_CLOSED) + 2
        self.spacing = _VOXEL
        while np.prod(shape := np.ceil((high - low) / self.spacing) + 1 + 2 * margin) > MOST_VOXELS:
            self.spacing *= 1.2
        origin = low - margin * self.spacing
        grid = VoxelGrid(origin, self.spacing, np.zeros(shape.astype(int), bool))
        for block in truth.blocks():
            grid.inside[tuple(grid.index(block.points).T)] = True
        solid = grid.inside
        if isinstance(head, Mesh):
            solid |= inside_mesh(grid, head)
        elif head is not None:
            axes = (self.spacing * np.arange(n) for n in shape)
            x, y, z = np.meshgrid(*axes, indexing="ij", sparse=True)
            a, b, c = head.center - origin
            solid |= (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2 < (0.95 * head.radius) ** 2
        grown = ndimage.binary_fill_holes(ndimage.distance_transform_edt(~solid) <= _CLOSED)
        depth = ndimage.distance_transform_edt(np.pad(grown, 1))[1:-1, 1:-1, 1:-1] - _CLOSED
        self._depth = (self.spacing * np.maximum(depth, 0)).astype(np.float32)
        self._grid = grid

    def regions(self, points: AnyFloats) -> Ints:
        """Indices into `DEPTHS (N,)` of `points (N, 3)`; outside the hair is outer."""
        ijk = self._grid.index(points)
        on = ((ijk >= 0) & (ijk < self._depth.shape)).all(axis=1)
        depth = np.zeros(len(points), np.float32)
        depth[on] = self._depth[tuple(ijk[on].T)]
        return np.asarray(depth > INNER + 0.5 * self.spacing, np.int64)
