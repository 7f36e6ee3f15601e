"""Frames on fewer pixels than were shot, made once: reading large pictures takes longest."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from reconstruction.arrays import Bools, Floats
from reconstruction.capture.folder import Capture

BYTES = 13
"""Of a kept pixel: three floats, and whether it is saturated."""
PREFIX = "frames-"
SPARE = 2.0
"""Times the space that frames take there must be on the disk for them to be kept."""


@contextmanager
def frames_kept(capture: Capture, beside: Path) -> Iterator[Capture]:
    """`capture`, of which a block reads the frames under single lights several times.

    Where the view is reduced they are averaged once and lie in a folder in `beside` meanwhile,
    where its disk has room; whatever else is read is read as before.
    """
    for left in beside.glob(f"{PREFIX}*"):  # by who was killed
        shutil.rmtree(left)
    needed = kept_bytes(capture)
    if not needed or shutil.disk_usage(beside).free < SPARE * needed:
        yield capture
        return
    with TemporaryDirectory(prefix=PREFIX, dir=beside) as folder:
        yield capture.keeping(KeptFrames(Path(folder)))


def kept_bytes(capture: Capture) -> int:
    """What `frames_kept` writes, bytes; 0 for a view that is not reduced."""
    if capture.reduced_by == 1:
        return 0
    size = {c.name: c.width * c.height for c in capture.rig.cameras}
    steps = capture.of_kind("olat")
    return BYTES * sum(n for name, n in size.items() for s in steps if capture.has(s, name))


class KeptFrames:
    """Means `(H, W, 3)` and saturated blocks `(H, W)` of frames, in a `folder` that is ours."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(
        self, step: int, camera: str, make: Callable[[], tuple[Floats, Bools]]
    ) -> tuple[Floats, Bools]:
        """A frame's; what `make` gives where it was not asked for before."""
        file = self.folder / f"{step:05d}-{camera}"
        if file.exists():
            with file.open("rb") as held:
                return np.load(held), np.load(held)
        made = make()
        part = file.with_suffix(".part")
        with part.open("wb") as out:
            for array in made:
                np.save(out, array)
        part.rename(file)
        return made
