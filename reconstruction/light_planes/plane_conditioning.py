"""How well each camera and projector of a rig triangulate: the angle between ray and plane."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Array, Bools
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lights import dome_positions
from reconstruction.geometry.projectors import Projector
from reconstruction.geometry.rig import Rig

GRAZING = 0.1  # least cosine to the surface of a visible or lit point of the sphere


@dataclass(frozen=True)
class PairConditioning:
    """One camera and one projector over the part of a head-sized sphere that both see.

    `shared` is that part as a share of the sphere's surface; the angles (degrees, ray to plane) and
    `metres_per_row` (median shift along the ray from one row to the next) are None where it is 0.
    """

    camera: str
    projector: str
    shared: float
    median_angle_deg: float | None
    low_angle_deg: float | None
    metres_per_row: float | None


@dataclass(frozen=True)
class RigConditioning:
    """Conditioning of every pair, and of all together.

    `visible` is the share of the sphere's surface visible in some camera, `triangulated` the part
    of it that a pair with an angle of at least `well_deg` covers, `well_pairs` the share of the
    pairs with a common part of over 2 % of the sphere whose median angle is at least `well_deg`.
    """

    pairs: tuple[PairConditioning, ...]
    visible: float
    triangulated: float
    well_pairs: float
    well_deg: float

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return asdict(self)


def ray_plane_angles(camera: Camera, projector: Projector, points: ArrayLike) -> Array:
    """Angles `(N,)` in [0, π/2] between the camera's rays to `points (N, 3)` and the planes.

    The plane of a point is that of the (fractional) row that lights it. The deviation of the depth
    along the ray grows with 1 / sin(angle).
    """
    points = np.asarray(points, float).reshape(-1, 3)
    rays = points - camera.center
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    normals = projector.plane(projector.project(points)[0][:, 1])[:, :3]
    return np.asarray(np.arcsin(np.clip(np.abs((rays * normals).sum(axis=1)), 0, 1)))


def row_pitch(projector: Projector, points: ArrayLike) -> Array:
    """Distance `(N,)` across the light plane between rows at `points (N, 3)`, metres."""
    points = np.asarray(points, float).reshape(-1, 3)
    y = (points @ projector.R.T + projector.t)[:, 1:]
    # the plane turns by d(atan y/z) per row about the projector's x axis
    tangent = y[:, 0] / y[:, 1]
    return np.asarray(np.linalg.norm(y, axis=1) / (projector.K[1, 1] * (1 + tangent**2)))


def condition(rig: Rig, *, radius: float = 0.12, well_deg: float = 25.0) -> RigConditioning:
    """Conditioning of every camera with every projector on a sphere of `radius` metres.

    A point counts where it faces both devices and lies in both images. Raises `ValueError` for a
    rig without projectors and for a radius of 0 or less.
    """
    if not 0 < radius < np.inf:
        raise ValueError(f"a sphere needs radius > 0 m, got {radius:g}")
    if not rig.projectors:
        raise ValueError(f"rig {rig.name}: no projectors, so no planes of light to condition")
    points = dome_positions(4000, radius)
    normals = points / radius

    def faces(device: Camera | Projector) -> Bools:
        to = device.center - points
        cosine = (to * normals).sum(axis=1) / np.linalg.norm(to, axis=1)
        pixels, depth = device.project(points)
        return np.asarray((cosine > GRAZING) & (depth > 0) & device.inside(pixels))

    lit = {p.name: faces(p) for p in rig.projectors}
    pairs, covered, visible = [], np.zeros(len(points), bool), np.zeros(len(points), bool)
    for camera in rig.cameras:
        here = faces(camera)
        visible |= here
        for projector in rig.projectors:
            both = here & lit[projector.name]
            angle = np.degrees(ray_plane_angles(camera, projector, points[both]))
            covered[both] |= angle >= well_deg
            shift = row_pitch(projector, points[both]) / np.sin(np.radians(np.maximum(angle, 0.1)))
            some = bool(both.any())
            pairs.append(
                PairConditioning(
                    camera.name,
                    projector.name,
                    float(both.mean()),
                    float(np.median(angle)) if some else None,
                    float(np.percentile(angle, 5)) if some else None,
                    float(np.median(shift)) if some else None,
                )
            )
    used = [p.median_angle_deg for p in pairs if p.shared > 0.02 and p.median_angle_deg is not None]
    return RigConditioning(
        tuple(pairs),
        float(visible.mean()),
        float(covered.sum() / max(int(visible.sum()), 1)),
        float(np.mean([a >= well_deg for a in used])) if used else 0.0,
        well_deg,
    )
