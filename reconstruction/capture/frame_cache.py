"""A disk cache for frames of a reduced view: reading full images takes longest."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from reconstruction.capture.folder import Capture, Pixels

BYTES = 13
"""Per cached pixel: three floats, and whether it is saturated."""
PREFIX = "frames-"
SPARE = 2.0
"""Free disk space required for the cache, in units of its size."""


@contextmanager
def cached_frames(capture: Capture, beside: Path) -> Iterator[Capture]:
    """`capture` with its single-light frames cached in a folder in `beside` during the block.

    Only a reduced view is cached, and only if the disk has `SPARE` times the space.
    """
    for left in beside.glob(f"{PREFIX}*"):  # of a killed process
        shutil.rmtree(left)
    needed = cache_bytes(capture)
    if not needed or shutil.disk_usage(beside).free < SPARE * needed:
        yield capture
        return
    with TemporaryDirectory(prefix=PREFIX, dir=beside) as folder:
        yield capture.with_cache(FrameCache(Path(folder)).get)


def cache_bytes(capture: Capture) -> int:
    """Size of the cache of `cached_frames`, bytes; 0 for a view that is not reduced."""
    if capture.reduced_by == 1:
        return 0
    size = {c.name: c.width * c.height for c in capture.rig.cameras}
    steps = capture.of_kind("olat")
    return BYTES * sum(n for name, n in size.items() for s in steps if capture.has(s, name))


class FrameCache:
    """Averaged pixels of frames, one file each in `folder`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(self, step: int, camera: str, compute: Callable[[], Pixels]) -> Pixels:
        """The pixels of one frame, from `compute` the first time."""
        path = self.folder / f"{step:05d}-{camera}"
        if path.exists():
            with path.open("rb") as file:
                return np.load(file), np.load(file)
        pixels = compute()
        part = path.with_suffix(".part")
        with part.open("wb") as file:
            for array in pixels:
                np.save(file, array)
        part.rename(path)
        return pixels
