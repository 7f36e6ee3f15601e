"""Options of inverse rendering: free parameters, resolution, and cost of an image."""

from __future__ import annotations

from dataclasses import field
from typing import Literal

from reconstruction.options import Count, options

Variant = Literal["original", "spatial", "correctives", "lights"]
"""The ablations of GroomLight's Table 1; each frees the parameters of those before it too."""


@options
class Effort:
    """The cost of an image: `pixels` of a view, `spp` paths of at most `max_depth` vertices."""

    pixels: Count = 120
    spp: Count = 32
    max_depth: Count = 8


@options
class InverseRenderingOptions:
    """How a fit is run.

    `shape` is the volume's (n_c, w, h), filled by `absorption_of_cells`. Roughness, mean colour and
    the lights' intensities are solved for by `solve_global_parameters`, correctives by
    `solve_correctives`. The fibres' index stays at the start's, a fibre's 1.55, unless
    `free_index`: on strands that are a little off their places it drifts, and changes the colour.
    """

    variant: Variant = "original"
    free_index: bool = False
    shape: tuple[Count, Count, Count] = (4, 8, 8)
    effort: Effort = field(default_factory=Effort)


@options
class InverseRenderingRequest:
    """The options of a job.

    Of the training lights `lights` are fitted and `validation_lights` decide whether the result is
    rendered (see `fit_validated`). `hair_pixels` a camera are fitted. `max_depth` is the largest
    number of vertices; None measures it. Held-out images have `judged_spp` paths a pixel. The
    defaults take a minute and are for the global parameters: maps (variants from "spatial" on) need
    24 lights, 4,000 pixels, and an `Effort` of 600 pixels and 128 paths.
    """

    lights: Count = 12
    validation_lights: Count = 4
    hair_pixels: Count = 600
    judged_spp: Count = 24
    max_depth: Count | None = None
    fit: InverseRenderingOptions = field(default_factory=InverseRenderingOptions)
