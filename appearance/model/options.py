"""Options of `assess`, in a module without Mitsuba: a service checks them without loading it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from reconstruction.options import Count, options


@options
class AssessOptions:
    """How much is compared: cameras and lights are spread evenly over what is there.

    `turning_frames` of `relit.webp`, under a rotating environment; 0 leaves it out.
    """

    cameras: Count = 2
    lights: Count = 5
    spp: Count = 24
    relit_size: Count = 640
    relit_spp: Count = 6
    turning_frames: Annotated[int, Field(ge=0, le=1000)] = 0
