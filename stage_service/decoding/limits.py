"""Limits of decoding: pixels, triangles, memory, seconds."""

from __future__ import annotations

from dataclasses import dataclass

MOST_MAP_PIXELS = 4096 * 2048
"""Pixels of an uploaded environment map, far above the resolution of 331 lights."""
MOST_FRAME_PIXELS = 160_000_000
"""Pixels of a frame; the largest sensors have 151 million."""
MOST_CHANNELS = 16
"""Channels of an OpenEXR file, which are all unpacked."""
MOST_TRIANGLES = 1_000_000
"""Triangles of a head, about 0.7 mm each."""


@dataclass(frozen=True)
class Limits:
    """Limits of decoding one file: bytes of additional `memory`, seconds of processor time and wall
    time, bytes of the response."""

    memory: int
    cpu_s: int = 30
    wall_s: float = 60.0
    """Twice the processor time, because the process has a low priority."""
    response: int = 512 << 20

    def exceeded(self, what: str) -> str:
        """Text for an exceeded limit: "memory", "processor" or "clock"."""
        return {
            "memory": f"needs more than {self.memory / 2**30:g} GiB of memory",
            "processor": f"takes more than {self.cpu_s} s of processor time",
            "clock": f"takes more than {self.wall_s:g} s",
        }[what]


GIVEN = Limits(2 << 30)
"""For files of requests: a map of `MOST_MAP_PIXELS` takes 1.3 GiB."""
FRAMES = Limits(6 << 30)
"""For the frames of captures: one of `MOST_FRAME_PIXELS` takes 4.5 GiB."""
