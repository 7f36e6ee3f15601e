"""Options of inverse rendering: resolution, and cost of an image."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated

from pydantic import Field

from reconstruction.options import Count, options


@options
class Effort:
    """The cost of an image: `pixels` of a view, `spp` paths of at most `max_depth` vertices."""

    pixels: Count = 120
    spp: Count = 32
    max_depth: Count = 8


@options
class InverseRenderingOptions:
    """How a fit is run.

    `shape` is the volume's (n_c, w, h) of the stages "spatial" and "correctives". The fibres' index
    stays at the start's, a fibre's 1.55, unless `free_index`: on strands that are a little off
    their places it drifts, and changes the colour. `light_power` is that of the cosine of lights
    without an axis, as of a data sheet (1 for a bare LED, half as bright at 60°); None fits it, and
    axes are less exact, by two to four times on hair under eight lights at 40 cm.
    """

    free_index: bool = False
    light_power: Annotated[float, Field(ge=0, le=50)] | None = None
    shape: tuple[Count, Count, Count] = (4, 8, 8)
    effort: Effort = field(default_factory=Effort)


@options
class InverseRenderingRequest:
    """The options of a job.

    Of the training lights `lights` are fitted and at most `validation_lights`, with a camera of
    four or more, decide which stages are kept. `hair_pixels` a camera are fitted, of images
    downsampled while hair has four times as many. `max_depth` is the largest number of vertices;
    None measures it.
    """

    lights: Count = 12
    validation_lights: Count = 4
    hair_pixels: Count = 600
    max_depth: Count | None = None
    fit: InverseRenderingOptions = field(default_factory=InverseRenderingOptions)
