"""Options of Sun's fit, in a module without Mitsuba: a service checks them without loading it."""

from __future__ import annotations

from reconstruction.options import Count, options


@options
class FitOptions:
    """Pixels a camera and cameras that a fit reads, and samples a pixel of its renderings.

    The renderings that give the error of the absorption have at least about `error_paths` paths.
    """

    hair_pixels: Count = 1000
    roughness_cameras: Count = 4
    roughness_spp: Count = 12
    colour_spp: Count = 16
    iterations: Count = 5
    error_paths: Count = 100_000
