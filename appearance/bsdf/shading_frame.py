"""From the shading frame that a renderer has to the one in which a fibre's BSDF is evaluated.

Rotation correctives are a small turn of that frame which repairs the strand's direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

SERIES_BELOW = 0.01
"""Squared angle below which sine and cosine are taken from their series."""


def rodrigues(axis_angle: Any, v: Any) -> Any:
    """`v` turned about `axis_angle` by its length in radians; smooth through zero.

    v + (sin a / a) w × v + ((1 - cos a)/a²) w × (w × v), both factors functions of a² alone.
    """
    squared = dr.squared_norm(axis_angle)
    small = squared < SERIES_BELOW
    angle = dr.sqrt(dr.select(small, 1, squared))
    sine = dr.select(
        small,
        1 - squared / 6 * (1 - squared / 20 * (1 - squared / 42)),
        dr.sin(angle) / angle,
    )
    half = dr.sin(0.5 * angle) / angle
    versine = dr.select(
        small, 0.5 - squared / 24 * (1 - squared / 30 * (1 - squared / 56)), 2 * half * half
    )
    turned = dr.cross(axis_angle, v)
    return v + sine * turned + versine * dr.cross(axis_angle, turned)


def axis_in_frame(a: Any, b: Any, reference_x: Any, reference_z: Any) -> tuple[Any, Any, Any]:
    """Axis-angle in the shading frame of the corrective `(a, b)` about a strand's own two normals.

    The first normal has the parts `reference_x`, `reference_z` across the fibre in the shading
    frame (of any length but 0), the second is the fibre's direction +y times the first. The part
    along the fibre, which would only shift h, is 0.
    """
    scale = dr.rsqrt(reference_x * reference_x + reference_z * reference_z + 1e-30)
    x, z = reference_x * scale, reference_z * scale
    return a * x + b * z, 0, a * z - b * x


@dataclass(frozen=True)
class ShadingFrame:
    """Turns of Mitsuba's shading frame at a hit; None where there is nothing to turn.

    `tangent`, the parts (x, y) of the fibre's own direction in Mitsuba's frame, replaces +y; then
    `axis` (axis-angle, in the frame so far) corrects all three.
    """

    tangent: tuple[Any, Any] | None
    axis: Any | None

    def enter(self, w: Any) -> Any:
        """`w` of Mitsuba's frame, in the fibre's."""
        if self.tangent is not None:
            x, y = self.tangent
            w = type(w)(y * w.x - x * w.y, x * w.x + y * w.y, w.z)
        return w if self.axis is None else rodrigues(-self.axis, w)

    def leave(self, w: Any) -> Any:
        """`w` of the fibre's frame, in Mitsuba's."""
        if self.axis is not None:
            w = rodrigues(self.axis, w)
        if self.tangent is None:
            return w
        x, y = self.tangent
        return type(w)(y * w.x + x * w.y, y * w.y - x * w.x, w.z)
