"""Hair maps as images: an EXR for each layer, and what they are in JSON."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from appearance.bsdf.maps import HairMaps
from reconstruction import write_exr
from reconstruction.arrays import Array, Floats
from reconstruction.files.durable import write_json

SCALARS = ("beta_m", "beta_n", "eta", "tilt_deg")


def export_maps(maps: HairMaps, folder: Path) -> list[Path]:
    """Write an EXR for each layer of absorption and correctives, and `maps.json`.

    `sigma_a_00.exr` is the root's layer; rows are v from the forehead to the nape, columns u.
    Correctives lie in red and green.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, table in (("sigma_a", maps.sigma_a), ("rotation", maps.rotation)):
        for i, layer in enumerate(table):
            written.append(folder / f"{name}_{i:02d}.exr")
            write_exr(written[-1], layer_image(layer))
    about = {"layers": len(maps.sigma_a), "units": "absorption per fibre radius; radians"}
    about |= {k: getattr(maps, k) for k in SCALARS}
    write_json(folder / "maps.json", about)
    return [*written, folder / "maps.json"]


def layer_image(layer: Array) -> Floats:
    """A layer `(w, h, 1 to 3)` of maps as an image `(h, w, 3)`: columns u, rows v."""
    image = np.zeros((layer.shape[1], layer.shape[0], 3), np.float32)
    image[..., : layer.shape[2]] = layer.transpose(1, 0, 2)
    return image
