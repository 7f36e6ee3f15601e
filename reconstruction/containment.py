"""Paths and names that others chose: in a request, or in a file that anybody may have written.

Whoever joins such a name to a folder, or opens such a path, asks here first.
"""

from __future__ import annotations

import stat
from pathlib import Path

LONGEST_NAME = 100
MOST_BYTES = 256 << 20


class NotContained(ValueError):
    """A path or name that leads elsewhere, or to what is no plain file."""


def inside(folder: Path, name: str) -> Path:
    """`folder / name`, which need not be there yet. Raises `NotContained`.

    Refused is what lies elsewhere once ".." and links are followed, and what no file can be called.
    """
    try:
        path = folder / name
        root, real = folder.resolve(), path.resolve()
        path.exists()  # complains where no file can be called so
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise NotContained(f"{str(name)[:LONGEST_NAME]!r} is no path: {error}") from error
    if real == root or not real.is_relative_to(root):
        raise NotContained(f"{str(name)[:LONGEST_NAME]!r} leads out of {folder}")
    return path


def is_file_name(name: object) -> bool:
    """Whether this can be (part of) a file's name: a camera's, say, whose frames are `NAME.exr`."""
    if not isinstance(name, str) or not 1 <= len(name) <= LONGEST_NAME or name[0] == ".":
        return False
    return name.isprintable() and not set(name) & set("/\\")


def plain_file(path: str | Path, most: int = MOST_BYTES) -> Path:
    """`path`, where it is a file of at most `most` bytes. Raises `NotContained`, `OSError`.

    A pipe or a device could be read for ever; neither is opened to find out.
    """
    path = Path(path)
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        raise NotContained(f"{path} is no plain file")
    if found.st_size > most:
        raise NotContained(f"{path} has {found.st_size:,} bytes; at most {most:,} are read")
    return path
