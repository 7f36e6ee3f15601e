"""Unreal: Alembic by Epic's "Alembic for Grooms Specification".

Centimetres, z up, right-handed: Unreal's settings for importing a groom (no rotation, scale
1, −1, 1) make its left-handed axes of that.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from appearance.export.groom import Groom
from reconstruction import Strands
from reconstruction.arrays import AnyFloats, Ints
from reconstruction.files.strands.alembic import add_curves, add_values, write_archive

CM = 100.0
MOST_POINTS = 255
"""Points of a strand; Unreal leaves out what follows."""
MOST_STRANDS = (1 << 22) - 1
MOST_GROUP_POINTS = 1 << 24
"""Strands and points of a group."""


def export_unreal(groom: Groom, path: Path) -> list[str]:
    """Write `/hair`, and `/guides` where there are any, of group 0; returns notes for the user.

    Strands of over `MOST_POINTS` are resampled; what a group cannot hold goes to `/hair_1` of group
    1, and so on, its guides with it. Of each strand `groom_id` and `groom_root_uv`, of each point
    `groom_width` and `groom_color`, of the guides `groom_guide`. Raises `StrandFileError` where the
    extra `alembic` is not installed.
    """
    notes, long = [], int((np.diff(groom.strands.offsets) > MOST_POINTS).sum())
    if long:
        notes.append(
            f"{long} strands have over {MOST_POINTS} points, the most that Unreal takes: they are "
            f"resampled to {MOST_POINTS} at equal arc lengths"
        )
        groom = replace(groom, strands=groom.strands.at_most(MOST_POINTS), confidence=None)
    groups = _groups(groom.strands.offsets)
    if len(groups) > 1:
        notes.append(
            f"a group of Unreal takes {MOST_STRANDS:,} strands and {MOST_GROUP_POINTS:,} points: "
            f"the {len(groom.strands):,} strands are in {len(groups)} groups"
        )
    colour = groom.colour(groom.looked_up[0])
    points = len(groom.strands.points) + len(groom.strands.subset(groom.guides).points)

    def fill(top: Any) -> None:
        offsets = groom.strands.offsets
        for k, which in enumerate(groups):
            suffix = f"_{k}" if k else ""
            first, end = (offsets[which[0]], offsets[which[-1] + 1]) if len(which) else (0, 0)
            _curves(top, f"hair{suffix}", groom, which, k, colour[first:end])
            guided = groom.guides[np.isin(groom.guides, which)]
            if len(guided):
                guides = _curves(top, f"guides{suffix}", groom, guided, k)
                add_values(guides, "groom_guide", np.array([1], np.int16), "constant")

    write_archive(path, 40 * points, fill)
    return notes


def _groups(offsets: Ints) -> list[Ints]:
    """Strands of each group, one after another, as many as it holds."""
    groups: list[Ints] = []
    start, count = 0, len(offsets) - 1
    while start < count or not groups:
        held = int(np.searchsorted(offsets, offsets[start] + MOST_GROUP_POINTS, "right")) - 1
        end = min(start + MOST_STRANDS, held, count)
        groups.append(np.arange(start, end))
        start = end
    return groups


def _curves(
    top: Any, name: str, groom: Groom, which: Ints, group: int, colour: AnyFloats | None = None
) -> Any:
    """The strands `which (M,)` as curves of a group, with the values of strands and guides."""
    strands = groom.strands.subset(which)
    large = Strands(CM * strands.points, strands.offsets, CM * strands.radius)
    curves = add_curves(top, name, large)
    width = np.full(len(large.points), 2 * large.radius, np.float32)
    add_values(curves, "groom_version_major", np.array([1], np.int16), "constant")
    add_values(curves, "groom_version_minor", np.array([5], np.int16), "constant")
    add_values(curves, "groom_tool", "hairstage", "constant")
    add_values(curves, "groom_group_id", np.array([group], np.int32), "constant")
    add_values(curves, "groom_id", groom.ids[which].astype(np.int32), "uniform")
    add_values(curves, "groom_root_uv", groom.st[which], "uniform")
    add_values(curves, "groom_width", width, "vertex")
    if colour is not None:
        add_values(curves, "groom_color", colour, "vertex")
    return curves
