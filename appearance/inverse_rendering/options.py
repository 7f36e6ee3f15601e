"""How a fit is run: what is free, how fine, and what a step may cost."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated, Literal

from pydantic import Field

from reconstruction.options import Count, options

Variant = Literal["original", "spatial", "correctives", "lights"]
"""The ablations of GroomLight's Table 1, each with what the ones before it free."""


@options
class Effort:
    """What one step may cost: `pixels` of a view, paths a pixel of at most `max_depth` vertices.

    The picture gets more paths (`spp`) than its gradient (`gradient_spp`): they cost an eighth, and
    the picture's noise multiplies the gradient's. Few steps of many paths beat many of few.
    """

    pixels: Count = 120
    spp: Count = 32
    gradient_spp: Count = 16
    max_depth: Count = 8
    rr_depth: Count = 3


@options
class InverseRenderingOptions:
    """How a fit is run.

    `shape` is the volume's (n_c, w, h), reached at once by `cell_start` (see
    `absorption_of_cells`), or else over `levels` doublings. With `gauss_newton` the numbers that
    all hair shares and the lights' intensities are solved for (see `global_parameters`), then
    correctives (see `correctives`), and steps are for what is left: the lights' places, in the
    variant "lights". There are at most `steps`, of `images` pairs each: lights of one view on
    shared paths, or pairs drawn one by one and rendered alone. `common_numbers` repeats the same
    random numbers for a view in every step. The validation error is that of `validation_views`
    views, every `check_every` steps; after `halvings` of the learning rate the fit has converged.
    The fibres' index stays that of the start, a fibre's 1.55, but with `free_index`: on strands
    that are a little off their places it drifts, and takes the colour along.
    """

    variant: Variant = "original"
    free_index: bool = False
    shape: tuple[Count, Count, Count] = (4, 8, 8)
    levels: Count = 3
    cell_start: bool = True
    gauss_newton: bool = True
    steps: Count = 60
    images: Count = 8
    effort: Effort = field(default_factory=Effort)
    residual_weighted: bool = True
    shared_paths: bool = True
    common_numbers: bool = False
    check_every: Count = 10
    halvings: Annotated[int, Field(ge=0)] = 2
    validation_views: Count = 3


@options
class InverseRenderingRequest:
    """What a job may ask for.

    Of the training lights `lights` are fitted and `validation_lights` decide whether the result is
    rendered (see `fit_validated`). `hair_pixels` a camera are fitted, one colour before the volume.
    `max_depth` is the number of vertices a path may have; None measures what the hair needs.
    Held-out images are judged with `judged_spp` paths a pixel. `fit` is how the fit is run. The
    defaults are what a minute buys, the numbers that all hair shares: maps (variants from "spatial"
    on) want 24 lights, 4,000 pixels, and an `Effort` of 600 pixels and 128 paths.
    """

    lights: Count = 12
    validation_lights: Count = 4
    hair_pixels: Count = 600
    judged_spp: Count = 24
    max_depth: Count | None = None
    fit: InverseRenderingOptions = field(default_factory=InverseRenderingOptions)
