"""Memory of a fit, estimated from its sizes.

Bytes are counted in the code and measured at the peak of fits; paths are those of brown hair.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from appearance.inverse_rendering.global_parameters import FEWEST
from appearance.inverse_rendering.options import InverseRenderingOptions
from appearance.inverse_rendering.problem import direct_spp
from appearance.render.olat import FILM_BYTES, OlatOptions
from appearance.render.tracing import LANE_BYTES

_KERNELS = 50_000_000
"""Kernels, of any scene: 25 to 75 MB, less where they need not be compiled."""
_POINT_BYTES, _BUILDING_BYTES = 225, 375
"""Of a strand's point in the scene, and at most while that is built."""
_FRAME_BYTES = 25
"""Of a captured pixel under a light."""
_WHOLE_BYTES, _GUESS_BYTES = 72, 120
"""Of a pixel under a light where full images are compared, and of each guess there."""
_PATH_BYTES = 3000
"""Of a cached path."""
_TURN_BYTES, _LIT_BYTES = 96, 30
"""Of a pixel under a light where fibres turn, and there of a path, which three in ten reach."""
_JUDGED_BYTES, _SHOWN_BYTES = 63, 100
"""Of a judged hair pixel under a light beside the renderer's film, and of a pixel of its frame."""


@dataclass(frozen=True)
class Sizes:
    """What a fit holds: `views` are the hair pixels of each that are fitted, under `lights`.

    `points` are those of all strands. Of whole frames that are judged, `hair` and `frame` are the
    pixels of the largest and `judged` how many there are of a camera; 0 where none is.
    """

    views: Sequence[int]
    lights: int
    points: int = 0
    hair: int = 0
    frame: int = 0
    judged: int = 0


def memory_needed(sizes: Sizes, options: InverseRenderingOptions) -> float:
    """GB that a fit takes, scene and kernels too, beside what the program holds before, about."""
    pixels, largest, lights = sum(sizes.views), max(sizes.views, default=0), sizes.lights
    # the start under the lights as found is a further guess
    guesses = 3 if options.variant == "lights" else 2
    whole = largest * lights * (_WHOLE_BYTES + guesses * _GUESS_BYTES)
    kept = min(largest, options.effort.pixels) * max(FEWEST, 2 * options.effort.spp)
    turns = 0
    if options.variant in ("correctives", "lights"):
        turns = pixels * lights * (_TURN_BYTES + direct_spp(pixels) * _LIT_BYTES)
    judged = min(sizes.hair * (LANE_BYTES + FILM_BYTES * sizes.judged), OlatOptions().memory)
    judged += sizes.hair * sizes.judged * _JUDGED_BYTES + sizes.frame * _SHOWN_BYTES
    fitting = _KERNELS + sizes.points * _POINT_BYTES + pixels * lights * _FRAME_BYTES
    fitting += max(whole, kept * _PATH_BYTES, turns, judged)
    return max(sizes.points * _BUILDING_BYTES, fitting) / 1e9
