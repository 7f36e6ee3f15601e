"""What decoding may take: pixels, triangles, memory, seconds."""

from __future__ import annotations

from dataclasses import dataclass

MOST_MAP_PIXELS = 4096 * 2048
"""Of an environment map from a request: 331 lights tell apart far less; larger ones are scaled down
before they are uploaded."""
MOST_FRAME_PIXELS = 160_000_000
"""Of a frame that is shown: the largest area sensors have 151 million."""
MOST_CHANNELS = 16
"""Of an OpenEXR file: all are unpacked, whichever are needed."""
MOST_TRIANGLES = 1_000_000
"""Of a head: some 0.7 mm from vertex to vertex all over it."""


@dataclass(frozen=True)
class Limits:
    """Of one file's decoding: bytes of `memory` beyond what the process begins with, seconds of
    processor time and by the clock, bytes of the answer."""

    memory: int
    cpu_s: int = 30
    wall_s: float = 60.0
    """Twice the processor's and more: the process has the lowest priority on a busy machine."""
    answer: int = 512 << 20

    def exceeded(self, what: str) -> str:
        """Which limit that is, as a sentence's end: "memory", "processor" or "clock"."""
        return {
            "memory": f"needs more than {self.memory / 2**30:g} GiB of memory",
            "processor": f"takes more than {self.cpu_s} s of processor time",
            "clock": f"takes more than {self.wall_s:g} s",
        }[what]


GIVEN = Limits(2 << 30)
"""For what a request brings: a map of `MOST_MAP_PIXELS` takes 1.3 GiB."""
FRAMES = Limits(6 << 30)
"""For the frames of captures: one of `MOST_FRAME_PIXELS` takes 4.5 GiB."""
