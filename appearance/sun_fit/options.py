"""What Sun's fit can be asked for; light, so that a service checks options without the fit."""

from __future__ import annotations

from reconstruction.options import Count, options


@options
class FitOptions:
    """How much of a capture a fit observes: pixels a camera, and samples a pixel when rendering."""

    hair_pixels: Count = 1000
    roughness_cameras: Count = 4
    roughness_spp: Count = 12
    colour_spp: Count = 16
    iterations: Count = 5
