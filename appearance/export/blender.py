"""Blender: a folder with the groom as arrays and a script that builds it there.

Blender's own importers make curves without the material and without their place on the scalp.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appearance.export.groom import Groom
from appearance.export.maps import SCALARS
from reconstruction.arrays import Floats, Ints
from reconstruction.files.durable import write_whole, writing

SCRIPT = "open_in_blender.py"


def export_blender(groom: Groom, folder: Path) -> list[Path]:
    """Write `open_in_blender.py` and `groom.npz`, which it reads; metres, z up.

    `blender --python FOLDER/open_in_blender.py` shows Hair Curves with a Principled Hair BSDF
    (Chiang) on a head; behind `--`, `--save FILE.blend` keeps them. For Blender 4.5 and newer.
    """
    folder.mkdir(parents=True, exist_ok=True)
    strands, maps = groom.strands, groom.maps
    sigma_a = np.array([maps.mean().sigma_a]) if maps.uniform else groom.looked_up[0]
    arrays: dict[str, NDArray[Any]] = {
        "points": strands.points,
        "counts": np.diff(strands.offsets).astype(np.int32),
        "radius": np.full(len(strands.points), strands.radius, np.float32),
        "root_uv": groom.st,
        "strand_id": groom.ids.astype(np.int32),
        "sigma_a": sigma_a.astype(np.float32),
        "guides": groom.guides.astype(np.int32),
        "skin": np.array(groom.skin, np.float32),
        **{name: np.array(getattr(maps, name), np.float32) for name in SCALARS},
    }
    if len(groom.guides):
        arrays["clump"] = groom.clump.astype(np.int32)
    if groom.confidence is not None:
        arrays["confidence"] = groom.confidence
    if groom.head is not None:
        arrays["head_vertices"] = groom.head.vertices.astype(np.float32)
        arrays["head_faces"] = groom.head.faces.astype(np.int32)
        if groom.head_st is not None:
            arrays["head_uv"] = _corners(groom.head_st, groom.head.faces)
    with writing(folder / "groom.npz") as part:
        np.savez(part, allow_pickle=False, **arrays)
    script = Path(__file__).with_name("in_blender.py").read_bytes()
    write_whole(folder / SCRIPT, script)
    return [folder / SCRIPT, folder / "groom.npz"]


def _corners(head_st: Floats, faces: Ints) -> Floats:
    """The scalp's map at the corners of the faces `(F, 3, 2)`, (-1, -1) at all of those off it.

    Blender finds a root on the head by the one face whose triangle on the map it lies in: faces
    that reach over the scalp's edge would lie across the whole map.
    """
    corners = head_st[faces]
    corners[(corners < 0).any(axis=(1, 2))] = -1
    return corners
