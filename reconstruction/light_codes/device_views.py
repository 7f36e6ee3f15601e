"""The views as flat arrays on Dr.Jit's device, and their samples at points in space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from reconstruction.light_codes.code_views import View

_UNIT = 32767.0  # a line's two numbers are kept as 16-bit fractions


@dataclass(frozen=True, eq=False)
class ViewSample:
    """One view at the projection of a point; all zero off its hair.

    `x`, `y` pixels; `lx`, `ly` the line there, its length the confidence; `equal` the share of the
    compared lights' bits that equal the reference's; `there` whether the pixel is on the hair.
    """

    x: Any
    y: Any
    lx: Any
    ly: Any
    equal: Any
    there: Any

    def cosine2(self, step: Any) -> Any:
        """Squared cosine on the image between the line and a `projection` of a direction."""
        ux, uy = step.x - self.x * step.z, step.y - self.y * step.z
        own = self.lx * self.lx + self.ly * self.ly
        same = ux * self.lx + uy * self.ly
        return same * same / dr.maximum((ux * ux + uy * uy) * own, 1e-20)


class DeviceViews:
    """Projections `(V, 12)`, lines and code words of all views, end to end in flat arrays."""

    def __init__(self, types: Any, views: Sequence[View]) -> None:
        self.types = types
        sizes = np.array([v.camera.width * v.camera.height for v in views])
        offsets = np.concatenate([[0], np.cumsum(sizes)[:-1]])
        geometry = np.array(
            [(v.camera.width, v.camera.height, o) for v, o in zip(views, offsets, strict=True)]
        )
        projections = np.stack(
            [v.camera.K @ np.column_stack([v.camera.R, v.camera.t]) for v in views]
        )
        lines = np.concatenate([v.lines.reshape(-1, 2) for v in views])
        fixed = np.rint(np.clip(lines, -1, 1) * _UNIT).astype(np.int16).view(np.uint16)
        words = np.concatenate([v.codes.words.reshape(-1, v.codes.words.shape[-1]) for v in views])
        f, u = types.Float, types.UInt32
        self.projections = f(projections.astype(np.float32).ravel())
        self.geometry = u(geometry.astype(np.uint32).ravel())
        self.lines = u(fixed[:, 0].astype(np.uint32) | fixed[:, 1].astype(np.uint32) << 16)
        self.words = [u(np.ascontiguousarray(w)) for w in words.T]
        varying, shot = (
            np.stack([getattr(v.codes, name) for v in views]).T for name in ("varying", "shot")
        )
        self.varying = [u(np.ascontiguousarray(w)) for w in varying]
        self.shot = [u(np.ascontiguousarray(w)) for w in shot]

    def projection(self, view: Any, point: Any, weight: float) -> Any:
        """Homogeneous pixels of `point` (weight 1) or of a direction (weight 0) in `view`."""
        f = self.types.Float
        row = [dr.gather(f, self.projections, 12 * view + k) for k in range(12)]
        return self.types.Array3f(
            *(
                row[4 * k] * point.x
                + row[4 * k + 1] * point.y
                + row[4 * k + 2] * point.z
                + weight * row[4 * k + 3]
                for k in range(3)
            )
        )

    def across(self, view: Any, line: Any) -> Any:
        """World normal of the plane through the view's centre and an image line `(a, b, c)`."""
        f = self.types.Float
        row = [dr.gather(f, self.projections, 12 * view + k) for k in range(12)]
        return self.types.Array3f(
            *(row[k] * line.x + row[4 + k] * line.y + row[8 + k] * line.z for k in range(3))
        )

    def compared_lights(self, view: Any, reference: Any) -> list[Any]:
        """Words of the lights that vary in either view and have a frame in both."""
        u = self.types.UInt32

        def both(words: Any) -> tuple[Any, Any]:
            return dr.gather(u, words, view), dr.gather(u, words, reference)

        pairs = [(*both(w), *both(s)) for w, s in zip(self.varying, self.shot, strict=True)]
        return [(a | b) & (c & d) for a, b, c, d in pairs]

    def corner(self, view: Any) -> tuple[Any, Any, Any]:
        """Width, height and offset in the flat arrays."""
        u = self.types.UInt32
        width, height, offset = (dr.gather(u, self.geometry, 3 * view + k) for k in range(3))
        return width, height, offset

    def sample(
        self, frame: tuple[Any, Any, Any], compared: list[Any], code: list[Any], h: Any, active: Any
    ) -> ViewSample:
        """The view with `corner` `frame` at homogeneous pixels `h`, compared with `code`.

        Without `compared` words all bits count as equal.
        """
        t = self.types
        width, height, offset = frame
        there = active & (h.z > 1e-6)
        inverse = dr.rcp(dr.select(there, h.z, 1))
        x, y = h.x * inverse, h.y * inverse
        there &= (x > -0.5) & (y > -0.5)
        there &= (x < t.Float(width) - 0.5) & (y < t.Float(height) - 0.5)
        index = offset + t.UInt32(y + 0.5) * width + t.UInt32(x + 0.5)
        packed = dr.gather(t.UInt32, self.lines, index, there)
        lx = t.Float(t.Int32(packed << 16) >> 16) * (1 / _UNIT)
        ly = t.Float(t.Int32(packed) >> 16) * (1 / _UNIT)
        there &= packed != 0
        same, total = t.UInt32(0), t.UInt32(0)
        for words, a, c in zip(self.words, compared, code, strict=False):
            same += dr.popcnt(~(dr.gather(t.UInt32, words, index, there) ^ c) & a)
            total += dr.popcnt(a)
        equal = dr.select(total > 0, t.Float(same) / dr.maximum(t.Float(total), 1), 1)
        return ViewSample(x, y, lx, ly, dr.select(there, equal, 0), there)
