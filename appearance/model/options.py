"""What `assess` can be asked for; light, so that a service checks options without Mitsuba."""

from __future__ import annotations

from reconstruction.options import Count, options


@options
class AssessOptions:
    """How much is compared: cameras and lights are spread evenly over what is there."""

    cameras: Count = 2
    lights: Count = 5
    spp: Count = 24
    relit_size: Count = 640
    relit_spp: Count = 12
