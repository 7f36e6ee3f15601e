"""Checks of untrusted paths and names before they are joined or opened."""

from __future__ import annotations

import stat
from pathlib import Path

LONGEST_NAME = 100
MOST_BYTES = 256 << 20


class NotContained(ValueError):
    """A path or name outside the folder, or of no regular file."""


def inside(folder: Path, name: str) -> Path:
    """`folder / name`, which need not exist.

    Raises `NotContained` for a path outside of `folder` once ".." and links are resolved, and for
    an invalid one.
    """
    try:
        path = folder / name
        root, real = folder.resolve(), path.resolve()
        path.exists()  # raises for an invalid name
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise NotContained(f"{str(name)[:LONGEST_NAME]!r} is no path: {error}") from error
    if real == root or not real.is_relative_to(root):
        raise NotContained(f"{str(name)[:LONGEST_NAME]!r} leads out of {folder}")
    return path


def is_file_name(name: object) -> bool:
    """Whether this can be (part of) a file's name, as a camera's, whose frames are `NAME.exr`."""
    if not isinstance(name, str) or not 1 <= len(name) <= LONGEST_NAME or name[0] == ".":
        return False
    return name.isprintable() and not set(name) & set("/\\")


def plain_file(path: str | Path, most: int = MOST_BYTES) -> Path:
    """`path`, if it is a regular file of at most `most` bytes. Raises `NotContained`, `OSError`.

    Nothing is opened: reading a pipe or a device may block.
    """
    path = Path(path)
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        raise NotContained(f"{path} is no plain file")
    if found.st_size > most:
        raise NotContained(f"{path} has {found.st_size:,} bytes; at most {most:,} are read")
    return path
