"""Memory of a fit, estimated from its sizes.

Bytes are counted in the code and measured at the peak of fits; paths are those of brown hair.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from appearance.inverse_rendering.global_parameters import FEWEST
from appearance.inverse_rendering.options import InverseRenderingOptions
from appearance.inverse_rendering.problem import direct_spp

_KERNELS = 50_000_000
"""Kernels, of any scene: 25 to 75 MB, less where they need not be compiled."""
_SCENE_BYTES = 150
"""Of a strand's point in the scene: its spline and the acceleration structure."""
_POINT_BYTES, _BUILDING_BYTES = 225, 375
"""The same with its coordinates on the hair, and at most while those are computed."""
_FRAME_BYTES = 25
"""Of a captured pixel under a light."""
_WHOLE_BYTES = 480
"""Of a fitted pixel under a light where full images, of six times as many pixels, are compared."""
_PATH_BYTES = 3000
"""Of a cached path."""
_TURN_BYTES, _LIT_BYTES = 96, 30
"""Of a pixel under a light where fibres turn, and there of a path, which three in ten reach."""


@dataclass(frozen=True)
class Sizes:
    """What a fit holds: `views` are the hair pixels of each under `lights`.

    `points` are those of all strands.
    """

    views: Sequence[int]
    lights: int
    points: int = 0


def scene_memory(points: int, beside: float = 0.0, *, mapped: bool = True) -> float:
    """GB of the scene of so many points of strands, its kernels, and `beside` that are used then.

    `mapped`: with coordinates on the hair.
    """
    if not mapped:
        return (_KERNELS + points * _SCENE_BYTES) / 1e9 + beside
    whole = (_KERNELS + points * _POINT_BYTES) / 1e9 + beside
    return max(points * _BUILDING_BYTES / 1e9, whole)


def memory_needed(sizes: Sizes, options: InverseRenderingOptions) -> float:
    """GB that a fit takes, scene and kernels too, beside what the program holds before, about."""
    pixels, largest, lights = sum(sizes.views), max(sizes.views, default=0), sizes.lights
    whole = largest * lights * _WHOLE_BYTES
    kept = min(largest, options.effort.pixels) * max(FEWEST, 2 * options.effort.spp)
    turns = pixels * lights * (_TURN_BYTES + direct_spp(pixels) * _LIT_BYTES)
    fitting = pixels * lights * _FRAME_BYTES + max(whole, kept * _PATH_BYTES, turns)
    return scene_memory(sizes.points, fitting / 1e9)
