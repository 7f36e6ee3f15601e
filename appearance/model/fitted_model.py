"""A fitted model as a scene: any view, light or environment, also on animated strands."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from appearance.bsdf.maps import HairMaps, MappedStrands
from appearance.inverse_rendering.pipeline import MAPS
from appearance.model.fitted_appearance import FittedAppearance
from appearance.scene.hair_scene import HairScene, build_scene
from reconstruction.files.strands import read_strands
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.strands import Strands


@dataclass(frozen=True, eq=False)
class FittedModel:
    """What a model folder holds: strands, maps, the head and its albedo.

    `root_uv (S, 2)` places the strands on the scalp's map; it was found at the fit's pose and
    stays with the strands when they move.
    """

    strands: Strands
    head: Mesh | None
    maps: HairMaps
    root_uv: np.ndarray
    skin: tuple[float, float, float]

    @classmethod
    def load(cls, model: Path, head: Mesh | None) -> FittedModel:
        """Read the folder `model`; errors name the file and what to do."""
        maps, root_uv = HairMaps.load(model / MAPS)
        strands = read_strands(model / "strands.npz")
        if len(strands) != len(root_uv):
            raise ValueError(
                f"{model}: {MAPS} is of {len(root_uv)} strands and strands.npz holds "
                f"{len(strands)}: fit again"
            )
        return cls(strands, head, maps, root_uv, FittedAppearance.load(model).skin)

    def scene(
        self, maps: HairMaps | None = None, strands: Strands | None = None, head: Mesh | None = None
    ) -> HairScene:
        """The scene for every renderer of `appearance.render`.

        With other `maps` (an edit), and with moved `strands` and `head` of the same topology.
        Raises `ValueError` where the strands' numbers of points differ.
        """
        moved = self.strands if strands is None else strands
        if not np.array_equal(moved.offsets, self.strands.offsets):
            raise ValueError(
                "animated strands must have the same numbers of points as the fitted ones: "
                f"{len(moved)} strands of {len(moved.points)} points, expected "
                f"{len(self.strands)} of {len(self.strands.points)}"
            )
        painted = self.maps if maps is None else maps
        base = build_scene(
            moved, self.head if head is None else head, hair=painted.mean(), skin=self.skin
        )
        return MappedStrands.of(base, moved, self.root_uv).painted(painted)
