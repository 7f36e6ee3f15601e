"""Symbolic links in the store: listed with their target, removed as links, never read if they lead
out of their folder.

`captures/`, `models/`, `uploads/` and the root may themselves be links, to a larger disk.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from reconstruction.reading import printable

MOST_NAMED = 20
"""Links that a list names."""


class LeadsOutside(ValueError):
    """A capture, model or upload is a link, or has links that lead out of it."""


def target_of(path: Path) -> str | None:
    """A link's target as written; None for anything else."""
    return printable(str(path.readlink())) if path.is_symlink() else None


def outward(folder: Path) -> list[str]:
    """The first links below `folder` that lead out of it, or nowhere, as "name -> target". Linked
    folders are not entered."""
    root, found = folder.resolve(), []
    for path in _links(folder):
        if not _inside(path, root):
            found.append(f"{printable(str(path.relative_to(folder)))} -> {target_of(path)}")
            if len(found) == MOST_NAMED:
                break
    return found


def _links(folder: Path) -> Iterator[Path]:
    """The links below a folder: in it by name, then in the folders in it."""
    try:
        with os.scandir(folder) as found:
            entries = sorted(found, key=lambda entry: entry.name)
    except OSError:
        return
    yield from (Path(entry.path) for entry in entries if entry.is_symlink())
    for entry in entries:
        if entry.is_dir(follow_symlinks=False):
            yield from _links(Path(entry.path))


def check_link(what: str, path: Path) -> None:
    """Raise `LeadsOutside` where `path`, called `what`, is a link."""
    if (target := target_of(path)) is not None:
        raise LeadsOutside(
            f"{what} is a link to {target}, which is not read: put the folder itself here, or "
            "remove the link (DELETE)"
        )


def check_links(what: str, path: Path) -> None:
    """Raise `LeadsOutside` where `path` is a link, or a link below it leads out of it."""
    check_link(what, path)
    if found := outward(path):
        raise LeadsOutside(
            f"{what} has links that lead out of it, which are not read: {', '.join(found[:3])}: "
            "put the files themselves here"
        )


def remove(path: Path) -> None:
    """Remove a link (never its target), a file, or a folder with its content."""
    if path.is_symlink() or not path.is_dir():
        path.unlink()
    else:
        shutil.rmtree(path)


def _inside(path: Path, root: Path) -> bool:
    try:
        return path.resolve(strict=True).is_relative_to(root)
    except (OSError, RuntimeError):  # no target, or a loop
        return False
