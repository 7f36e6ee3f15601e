"""The frame and unit of a user's cameras, in which the results of an imported capture are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import Field

from reconstruction.arrays import AnyFloats, Array
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.placement import Up, to_z_up
from reconstruction.geometry.strands import Strands
from reconstruction.options import options, parse_options

T = TypeVar("T", Strands, Mesh)

FURTHEST_ORIGIN = 100.0
"""Metres from the origin up to which float32, which strand files store, resolves 8 µm."""


@dataclass(frozen=True, eq=False)
class WorldFrame:
    """A user's world: its `unit` in metres and the axis that points `up`.

    `origin (3,)` is the stage's origin in that world turned to z up, metres.
    """

    unit: float = 1.0
    up: Up = "z"
    origin: Array = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def from_dict(cls, data: Any, where: str) -> WorldFrame:
        """Read what `to_dict` made. Raises `ValueError` naming the field in `where`."""
        read = parse_options(_Record, data, where)
        return cls(read.unit, read.up, np.array(read.origin))

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready description."""
        return {"unit": self.unit, "up": self.up, "origin": self.origin.tolist()}

    def __str__(self) -> str:
        at = ", ".join(f"{x:g}" for x in self.origin)
        return f"{self.up} up, unit {self.unit:g} m, the stage's origin at ({at}) m (z up)"

    @property
    def same(self) -> bool:
        """Whether it is the stage's frame."""
        return self.to_dict() == WorldFrame().to_dict()

    @property
    def in_metres(self) -> WorldFrame:
        """The same world in metres with z up, for formats that fix unit and axes."""
        return WorldFrame(1.0, "z", self.origin)

    @property
    def usd_up(self) -> Up:
        """The up axis that USD can state for this world: y or z."""
        return "y" if self.up == "y" else "z"

    @property
    def as_read_from_usd(self) -> WorldFrame:
        """The world of USD files once their unit and up axis are converted to metres and z up."""
        return WorldFrame(1.0, "z" if self.up == self.usd_up else self.up, self.origin)

    @classmethod
    def of_plan(cls, plan: Mapping[str, Any]) -> WorldFrame | None:
        """The frame that the plan of an import has. Raises `ValueError` or `TypeError`."""
        record = plan.get("import")
        if not isinstance(record, dict) or "frame" not in record:
            return None
        return cls.from_dict(record["frame"], "import.frame")

    def to_user(self, points: AnyFloats) -> Array:
        """Points `(N, 3)` of the stage in the user's frame and unit."""
        moved = np.asarray(points, float) + self.origin
        return np.asarray(moved @ to_z_up(self.up) / self.unit)

    def to_stage(self, points: AnyFloats) -> Array:
        """Points `(N, 3)` of the user's frame and unit in the stage's."""
        turned = np.asarray(points, float) @ to_z_up(self.up).T
        return np.asarray(self.unit * turned - self.origin)

    def results(self, found: T) -> T:
        """Strands (with their radius) or a mesh of the stage in the user's frame and unit."""
        if isinstance(found, Mesh):
            return replace(found, vertices=self.to_user(found.vertices))
        points = self.to_user(found.points).astype(np.float32)
        return replace(found, points=points, radius=found.radius / self.unit)

    def inputs(self, given: T) -> T:
        """Strands (with their radius) or a mesh of the user's frame and unit in the stage's."""
        if isinstance(given, Mesh):
            return replace(given, vertices=self.to_stage(given.vertices))
        points = self.to_stage(given.points).astype(np.float32)
        return replace(given, points=points, radius=given.radius * self.unit)


@options
class _Record:
    """`WorldFrame` in JSON."""

    unit: Annotated[float, Field(gt=0)] = 1.0
    up: Up = "z"
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
