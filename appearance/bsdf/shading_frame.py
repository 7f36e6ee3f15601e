"""From the shading frame that a renderer has to the one in which a fibre's BSDF is evaluated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from appearance.bsdf.corrective import rodrigues


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
