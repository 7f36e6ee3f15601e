"""A fitted model, to be rendered, relit, edited and exported."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from appearance.bsdf.absorption import of_melanin
from appearance.bsdf.longitudinal import colour_of_absorption, variance_of_roughness
from appearance.bsdf.maps import HairMaps, MappedStrands, scalp_coordinates
from appearance.fields.field import FIELD_FILE, Field, FieldOnStrands
from appearance.inverse_rendering.fitted_lights import LIGHTS_FILE, fitted_lights
from appearance.metrics.scores import Exposure
from appearance.observations import HeldOut
from appearance.render.mixed import Environment, render_mixed
from appearance.render.tracing import SAMPLING, Sampling
from appearance.scene.hair_appearance import HairAppearance
from appearance.scene.hair_scene import HairScene, build_scene
from appearance.sun_fit.fitted_appearance import FittedAppearance
from reconstruction import Camera, Capture, Light, Mesh, Model, ModelError, Rig, Strands
from reconstruction.arrays import Array, Floats

BROWN = 1.3, 0.0
"""Eumelanin and pheomelanin of brown hair (d'Eon et al. 2011, as in pbrt)."""
SKIN = 0.5, 0.35, 0.28


@dataclass(frozen=True, eq=False)
class FittedModel:
    """Strands on a head, the hair's material, skin, exposure and lights.

    `field` is the reflectance field, if one was fitted. `maps` have one cell for uniform hair.
    `placed (S, 2)` are the roots on the scalp's map, if known, also of moved strands. `rig` is the
    capture's with fitted light intensities; `light_rows` are the rows of `lights.json`, empty if
    lights were not fitted.
    """

    strands: Strands
    head: Mesh | None
    appearance: FittedAppearance
    maps: HairMaps
    placed: Array | None = None
    rig: Rig | None = None
    light_rows: Sequence[Mapping[str, Any]] = ()
    field: Field | None = None

    @classmethod
    def load(
        cls, model: Model, capture: Capture | None = None, *, with_field: bool = True
    ) -> FittedModel:
        """Read a model; `capture` gives the rig, and the head if the model has none.

        Its field is left out unless `with_field`. Raises `ModelError` naming what is missing.
        """
        appearance, strands = FittedAppearance.load(model), model.strands()
        maps, placed = HairMaps.of(appearance.hair), model.root_uv(strands)
        if model.has("hair_maps.npz"):
            maps, placed = HairMaps.load(model)
            if len(strands) != len(placed):
                raise ModelError(
                    f"{model.file('hair_maps.npz')} is of {len(placed)} strands and strands.npz "
                    f"holds {len(strands)}: fit again"
                )
        rig = None
        if capture is not None:
            rig = replace(capture.rig, lights=tuple(fitted_lights(model, capture.rig.lights)))
        found = model.json(LIGHTS_FILE) if model.has(LIGHTS_FILE) else ()
        field = Field.load(model) if with_field and model.has(FIELD_FILE) else None
        if field is not None and len(field.places.kept) != len(strands):
            raise ModelError(
                f"{model.file(FIELD_FILE)} is of {len(field.places.kept)} strands and strands.npz "
                f"holds {len(strands)}: fit again"
            )
        return cls(strands, model.head(capture), appearance, maps, placed, rig, found, field)

    @classmethod
    def unfitted(cls, model: Model, capture: Capture | None = None) -> FittedModel:
        """A model without a fit, as brown hair. Raises `ModelError` if it has no strands."""
        strands, hair = model.strands(), HairAppearance(of_melanin(*BROWN), 0.3, 0.3)
        colour = tuple(float(c) for c in colour_of_absorption(hair.sigma_a, hair.beta_n))
        v = float(variance_of_roughness(hair.beta_m))
        r, g, b = colour
        appearance = FittedAppearance(hair, (r, g, b), SKIN, Exposure(1.0), v, v, v, HeldOut())
        maps, head = HairMaps.of(hair), model.head(capture)
        rig = None if capture is None else capture.rig
        return cls(strands, head, appearance, maps, model.root_uv(strands), rig, (), None)

    @classmethod
    def alternatives(cls, model: Model, capture: Capture) -> dict[str, FittedModel]:
        """Both fits without a field, "sun_fit" and "inverse_rendering".

        Empty if the model is rendered with Sun's fit.
        """
        if not model.has("hair_maps.npz"):
            return {}
        found = cls.load(model, capture, with_field=False)
        sun = replace(found, maps=HairMaps.of(found.appearance.hair), rig=capture.rig)
        return {"sun_fit": sun, "inverse_rendering": found}

    def save(self, model: Model) -> None:
        """Write a model without report and images; its `appearance.json` has the mean of maps."""
        appearance, hair = self.appearance, self.maps.mean()
        if hair != appearance.hair:
            red, green, blue = colour_of_absorption(hair.sigma_a, hair.beta_n)
            v = float(variance_of_roughness(hair.beta_m))
            appearance = replace(
                appearance,
                hair=hair,
                colour=(red, green, blue),
                v=v,
                beta_m_error=None,
                beta_m_interval=None,
                sigma_a_error=None,
            )
        model.create().write_strands(self.strands)
        if self.head is not None:
            model.write_head(self.head)
        appearance.save(model)
        if self.placed is not None or not self.maps.uniform:
            self.maps.save(model, self.root_uv)
        if self.light_rows:
            model.write_json(LIGHTS_FILE, list(self.light_rows))
        if self.field is not None:
            self.field.save(model)

    @cached_property
    def root_uv(self) -> Array:
        """The roots' places on the scalp's map `(S, 2)` in [0, 1]."""
        return scalp_coordinates(self.strands, self.head) if self.placed is None else self.placed

    def with_maps(self, maps: HairMaps) -> FittedModel:
        """The same with another material."""
        return replace(self, maps=maps)

    def without_field(self) -> FittedModel:
        """The same without a field."""
        return replace(self, field=None)

    def lights(self, names: Sequence[str]) -> list[Light]:
        """Lights of the rig: fitted ones, else as calibrated."""
        if self.rig is None:
            raise ValueError("lights are parts of a rig: give the capture too")
        return [self.rig.light(name) for name in names]

    def scene(self, strands: Strands | None = None, head: Mesh | None = None) -> HairScene:
        """The scene for every renderer of `appearance.render`.

        With moved `strands` and `head` of the same topology, and the model's radii. Raises
        `ValueError` if the strands' numbers of points differ.
        """
        moved = self.strands if strands is None else strands
        if not np.array_equal(moved.offsets, self.strands.offsets):
            raise ValueError(
                "animated strands must have the same numbers of points as the fitted ones: "
                f"{len(moved)} strands of {len(moved.points)} points, expected "
                f"{len(self.strands)} of {len(self.strands.points)}"
            )
        moved = replace(moved, radius=self.strands.radius)
        base = build_scene(
            moved,
            self.head if head is None else head,
            hair=self.maps.mean(),
            skin=self.appearance.skin,
        )
        if not len(moved) or (self.maps.uniform and self.field is None):
            return base
        mapped = MappedStrands.of(base, moved, self.root_uv)
        shown = base if self.maps.uniform else mapped.with_maps(self.maps)
        if self.field is None:
            return shown
        return replace(shown, field=FieldOnStrands(self.field, mapped))

    def mapped(self) -> MappedStrands:
        """The strands with their places, and the scene of their material without a field."""
        scene = self.without_field().scene()
        return MappedStrands.of(scene, self.strands, self.root_uv)

    def render(
        self,
        camera: Camera,
        lights: Sequence[Light] = (),
        environments: Sequence[Environment] = (),
        sampling: Sampling = SAMPLING,
        *,
        weights: ArrayLike = 1.0,
    ) -> Floats:
        """Radiance `(H, W, 3)` under lights and environments together; see `render_mixed`."""
        return render_mixed(self.scene(), camera, lights, environments, sampling, weights=weights)
