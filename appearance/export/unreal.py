"""Unreal: Alembic by Epic's "Alembic for Grooms Specification".

Centimetres, z up, right-handed: Unreal's settings for importing a groom (no rotation, scale
1, −1, 1) make its left-handed axes of that.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from appearance.export.groom import Groom
from reconstruction import Strands
from reconstruction.arrays import AnyFloats, Ints
from reconstruction.files.strands.alembic import add_curves, add_values, write_archive

CM = 100.0


def export_unreal(groom: Groom, path: Path) -> None:
    """Write `/hair`, and `/guides` where there are any, both of group 0.

    Of each strand `groom_id` and `groom_root_uv`, of each point `groom_width` and `groom_color`, of
    the guides `groom_guide`. Raises `StrandFileError` where the extra `alembic` is not installed.
    """
    every = np.arange(len(groom.strands))
    colour = groom.colour(groom.looked_up[0])
    points = len(groom.strands.points) + len(groom.strands.subset(groom.guides).points)

    def fill(top: Any) -> None:
        _curves(top, "hair", groom, every, colour)
        if len(groom.guides):
            guides = _curves(top, "guides", groom, groom.guides)
            add_values(guides, "groom_guide", np.array([1], np.int16), "constant")

    write_archive(path, 40 * points, fill)


def _curves(top: Any, name: str, groom: Groom, which: Ints, colour: AnyFloats | None = None) -> Any:
    """The strands `which (M,)` as curves, with the values that strands and guides share."""
    strands = groom.strands.subset(which)
    large = Strands(CM * strands.points, strands.offsets, CM * strands.radius)
    curves = add_curves(top, name, large)
    width = np.full(len(large.points), 2 * large.radius, np.float32)
    add_values(curves, "groom_version_major", np.array([1], np.int16), "constant")
    add_values(curves, "groom_version_minor", np.array([5], np.int16), "constant")
    add_values(curves, "groom_tool", "hairstage", "constant")
    add_values(curves, "groom_group_id", np.array([0], np.int32), "constant")
    add_values(curves, "groom_id", groom.ids[which].astype(np.int32), "uniform")
    add_values(curves, "groom_root_uv", groom.st[which], "uniform")
    add_values(curves, "groom_width", width, "vertex")
    if colour is not None:
        add_values(curves, "groom_color", colour, "vertex")
    return curves
