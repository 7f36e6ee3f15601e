"""The origin of an imported capture, moved to the subject, where all later steps expect it.

COLMAP's origin is arbitrary, a stage's often on the floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from reconstruction.arrays import Array
from reconstruction.capture.import_tables import obj_in_stage
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.placement import FURTHEST, NEAREST, PlacementError, Sight
from reconstruction.geometry.rig import Rig
from reconstruction.geometry.world_frame import FURTHEST_ORIGIN, WorldFrame

NEAR = 0.1
"""Metres: distance of the subject from the origin up to which nothing is moved."""
SPREAD = 0.03
"""Least `Sight.diversity` (axes 14° from their mean) that determines the subject's distance."""


@dataclass(frozen=True, eq=False)
class Origin:
    """The capture's origin as a `point (3,)` of the user's frame, metres with z up; 0 if unmoved.

    `notes` are for the user.
    """

    point: Array = field(default_factory=lambda: np.zeros(3))
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> Origin:
        """The point that the cameras look at, in whole millimetres, if it is not at the origin."""
        try:
            sight = Sight.of(cameras)
        except PlacementError:
            alone = "there is only one" if len(cameras) == 1 else "their axes are parallel"
            return cls(notes=(_unknown(alone),))
        point = np.round(sight.point, 3) + 0.0  # no -0
        if np.linalg.norm(point) <= NEAR:
            return cls()
        distance = float(np.median(sight.distance))
        if not sight.whole:
            return cls(notes=(_unknown("they do not look at one point"),))
        if not NEAREST <= distance <= FURTHEST:
            return cls(
                notes=(_unknown(f"they are {distance:.3g} m from the point that they look at"),)
            )
        if sight.diversity < SPREAD:
            return cls(notes=(_unknown("their axes are nearly parallel"),))
        return cls(point, (_moved(point),))

    @property
    def moved(self) -> bool:
        """Whether it differs from the user's."""
        return bool(self.point.any())

    @property
    def stored(self) -> Array:
        """`point` as far as files of results can store it, else 0."""
        return self.point if np.linalg.norm(self.point) <= FURTHEST_ORIGIN else np.zeros(3)

    def rig(self, rig: Rig) -> Rig:
        """`rig` relative to the new origin."""
        if not self.moved:
            return rig
        still, back = np.eye(3), self.point
        return replace(
            rig,
            cameras=tuple(c.moved(still, back) for c in rig.cameras),
            lights=tuple(x.moved(still, back) for x in rig.lights),
            projectors=tuple(p.moved(still, back) for p in rig.projectors),
        )

    def head(self, head: Mesh | None) -> Mesh | None:
        """`head` relative to the new origin."""
        if head is None or not self.moved:
            return head
        return head.transformed(np.eye(3), -self.point)

    def obj(self, text: str) -> str:
        """The text of an OBJ relative to the new origin."""
        if not self.moved:
            return text
        return obj_in_stage(text, WorldFrame(origin=self.point))


def _moved(point: Array) -> str:
    return (
        f"the cameras look at {_text(point)} m; cameras, lights, projectors, head.obj and "
        f"scalp.obj were moved by {_text(-point)} m, so that the subject is at the origin. "
        + (
            "Results come back in your frame"
            if np.linalg.norm(point) <= FURTHEST_ORIGIN
            else "Single precision cannot store strands so far from your origin: results stay at "
            f"the new one; add {_text(point)} m (z up)"
        )
    )


def _unknown(why: str) -> str:
    return (
        f"the cameras do not determine the subject's position, as {why}: it is assumed at the "
        "origin; if it is elsewhere, move cameras, lights and head"
    )


def _text(point: Array) -> str:
    return "(" + ", ".join(f"{x:.3f}" for x in point + 0.0) + ")"
