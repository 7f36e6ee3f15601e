"""The origin of an imported world, moved to the subject: all after the import takes it to be there.

COLMAP's origin is anywhere, a stage's often on the floor. Baselines, environments, warnings and the
first directions of strands go by where lights stand from the origin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from reconstruction.arrays import Array
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.placement import FURTHEST, NEAREST, PlacementError, Sight
from reconstruction.geometry.rig import Rig

NEAR = 0.1
"""Metres: a subject that is this near to the origin stays where it is."""
SPREAD = 0.03
"""The least `Sight.diversity`, axes 14° from their mean, that tells how far away the subject is."""


@dataclass(frozen=True, eq=False)
class Origin:
    """`point (3,)` of the user's world, in metres with z up, is the origin of the capture's.

    It is 0 where nothing is moved; `notes` for the user.
    """

    point: Array = field(default_factory=lambda: np.zeros(3))
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> Origin:
        """What the cameras look at, in whole millimetres, where it is not about the origin."""
        try:
            sight = Sight.of(cameras)
        except PlacementError:
            alone = "there is but one" if len(cameras) == 1 else "they all look the same way"
            return cls(notes=(_unknown(alone),))
        point = np.round(sight.point, 3) + 0.0  # no -0
        if np.linalg.norm(point) <= NEAR:
            return cls()
        distance = float(np.median(sight.distance))
        if not sight.whole:
            return cls(notes=(_unknown("they do not look at one place"),))
        if not NEAREST <= distance <= FURTHEST:
            return cls(notes=(_unknown(f"they stand {distance:.3g} m from what they look at"),))
        if sight.diversity < SPREAD:
            return cls(notes=(_unknown("they look nearly the same way"),))
        return cls(point, (_told(point),))

    @property
    def moved(self) -> bool:
        """Whether it is another one than the user's."""
        return bool(self.point.any())

    def rig(self, rig: Rig) -> Rig:
        """`rig` about the new origin."""
        if not self.moved:
            return rig
        still, back = np.eye(3), self.point  # devices that see what they saw before
        return replace(
            rig,
            cameras=tuple(c.moved(still, back) for c in rig.cameras),
            lights=tuple(x.moved(still, back) for x in rig.lights),
            projectors=tuple(p.moved(still, back) for p in rig.projectors),
        )

    def head(self, head: Mesh | None) -> Mesh | None:
        """`head` about the new origin."""
        if head is None or not self.moved:
            return head
        return head.transformed(np.eye(3), -self.point)

    def obj(self, text: str) -> str:
        """The text of an OBJ about the new origin."""
        if not self.moved:
            return text
        return "".join(self._line(line) for line in text.splitlines(keepends=True))

    def _line(self, line: str) -> str:
        words = line.split()
        if words[:1] != ["v"]:
            return line
        place = np.array(words[1:4], float) - self.point
        return " ".join(["v", *(f"{x:.9g}" for x in place), *words[4:]]) + "\n"


def _told(point: Array) -> str:
    return (
        f"the cameras look at {_text(point)} m of their world, not at its origin, about which a "
        f"capture's subject is: cameras, lights, projectors, head.obj and scalp.obj were moved by "
        f"{_text(-point)} m. Add {_text(point)} m to results to have them in your world, in metres "
        "with z up; take it off what you give later"
    )


def _unknown(why: str) -> str:
    return (
        f"where the subject is cannot be told from the cameras, as {why}: it is taken to be about "
        "the origin of their world; if it is not, move cameras, lights and head there"
    )


def _text(point: Array) -> str:
    return "(" + ", ".join(f"{x:.3f}" for x in point + 0.0) + ")"
