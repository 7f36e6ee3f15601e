"""Where a model's strands are rooted on the flat map of its scalp: `scalp_map.npz`."""

from __future__ import annotations

import numpy as np

from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.strands import Strands
from reconstruction.head.scalp import Scalp
from reconstruction.head.scalp_map import ScalpMap
from reconstruction.model import Model
from reconstruction.report.report import Stage


def write_root_map(
    model: Model, strands: Strands, scalp: Scalp, flat: ScalpMap | None, stage: Stage
) -> None:
    """Write `scalp_map.npz` into `model`: the (u, v) of every root, and the map on the scalp.

    roots (S, 2) float32     of each strand, in the order of `strands.npz`
    uv (V, 2) float32        of the scalp's `vertices (V, 3)`, of which `faces (F, 3)` are made

    `flat` is the map that the head has from its template; without one, the head is taken to be in
    its own frame (z up, face towards −y). A scalp whose map would fold has none: the stage warns.
    """
    if flat is None:
        marked = scalp.head.scalp if scalp.marked else scalp.share >= 0.5
        try:
            flat = ScalpMap.of(Mesh(scalp.head.vertices, scalp.head.faces, marked))
        except ValueError as error:
            model.remove("scalp_map.npz")
            stage.warn(f"no scalp_map.npz: {error}")
            return
    uv, distance = flat(strands.roots)
    used, faces = np.unique(flat.head.faces[flat.head.scalp], return_inverse=True)
    model.write_arrays(
        "scalp_map.npz",
        {
            "roots": uv.astype(np.float32),
            "uv": flat.uv[used].astype(np.float32),
            "vertices": flat.head.vertices[used],
            "faces": faces.reshape(-1, 3),
        },
    )
    stage.figures["roots_off_the_map_mm"] = float(distance.max(initial=0.0) * 1e3)
