"""Images by Photobooth's reflectance field: captured frames interpolated on a model's strands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from appearance.bsdf.maps import MappedStrands
from appearance.fields.hits import find_hits
from appearance.fields.interpolation import HITS, Interpolation
from appearance.fields.reflectance import gather
from appearance.fields.search import searched
from appearance.model.fitted_model import FittedModel
from appearance.observations import HeldOut
from appearance.render.coverage import coverage
from appearance.render.environment_maps import check_environment, subdivided
from appearance.render.mixed import Environment
from reconstruction import (
    Camera,
    Capture,
    Light,
    Model,
    ModelError,
    Progress,
    Stage,
    Strands,
    silent,
)
from reconstruction.arrays import AnyFloats, Array, Floats
from reconstruction.options import options
from reconstruction.report.progress import part_of

ROWS = 16
"""Rows of cells of an environment map, a far light each: 11°, the spacing of 331 lights."""
FAR = 1e3
"""Metres to the lights of an environment."""


@options
class InterpolationOptions:
    """How captured frames are interpolated.

    `guide`: "kajiya_kay" (Photobooth §4.2), its parameters searched with `left_out` lights left out
    one at a time; or "none", standard interpolation (§4.1).
    """

    guide: Literal["kajiya_kay", "none"] = "kajiya_kay"
    left_out: Annotated[int, Field(ge=1, le=64)] = 4


def interpolation_of(
    fitted: FittedModel,
    model: Model,
    capture: Capture,
    *,
    stage: Stage,
    held_out: HeldOut | None = None,
    options: InterpolationOptions | None = None,
    progress: Progress = silent,
) -> Interpolation:
    """The frames of `capture` that are not `held_out`, ready to be interpolated on its strands.

    They are stored in the model's folder `samples`, by camera, mapped into memory. `stage` gets the
    guide's parameters with their spread, the bytes, and warnings. Raises `ModelError` if no camera
    sees hair.
    """
    options, training = options or InterpolationOptions(), (held_out or HeldOut()).training(capture)
    training = training.view(undistorted=True)
    masks = {
        c.name: np.flatnonzero(model.mask(c.name, "hair", training)) for c in training.rig.cameras
    }
    folder = model.file("samples")
    exposure = fitted.appearance.exposure.scale
    field = gather(training, masks, exposure, folder=folder, progress=part_of(progress, 0.0, 0.5))
    if not field.views:
        raise ModelError(f"{model}: the hair masks of the cameras are all empty")
    scene = fitted.scene()
    mapped = MappedStrands.of(scene, fitted.strands, fitted.root_uv)
    found = Interpolation.of(field, mapped, fitted.strands)
    stage.figures |= {"cameras": len(field.views), "lights": len(field.lights)}
    stage.figures |= {"sample_bytes": field.bytes}
    if options.guide == "none":
        return found
    count = len(field.lights)
    most = min(options.left_out, count - 2)
    if most < 1:
        stage.warn("too few lights to leave one out: standard interpolation is used")
        return found
    names = [field.lights[int((i + 0.5) * count / most)].name for i in range(most)]
    search = searched(found, names, progress=part_of(progress, 0.5, 1.0))
    search.record(stage)
    return replace(found, model=search.best)


@dataclass(frozen=True, eq=False)
class Pose:
    """A model's strands as they are rendered: `strands` of the same topology, None at rest."""

    fitted: FittedModel
    strands: Strands | None = None

    @property
    def mapped(self) -> MappedStrands:
        """The strands' scene with their places."""
        strands = self.fitted.strands if self.strands is None else self.strands
        return MappedStrands.of(self.fitted.scene(strands), strands, self.fitted.root_uv)


def with_samples(
    base: AnyFloats,
    interpolation: Interpolation,
    pose: Pose,
    camera: Camera,
    lights: Sequence[Light],
) -> tuple[Floats, dict[str, Any]]:
    """The image `base (H, W, 3)` of a model, its hair interpolated from captured frames.

    Under all `lights` together. `base` stays off the hair, and where no camera captured it. Also
    returned: "hair_unseen", the share of the hair that no camera captured.
    """
    image = np.array(base, np.float32)
    flat = image.reshape(-1, 3)
    source = None if pose.strands is not None else _source(interpolation, camera)
    if source is not None:
        radiance, known = interpolation.at_hits(source.hits).under_all(lights)
        served = known > 0
        flat[source.view.pixels[served]] = radiance[served]
        return image, {"hair_unseen": float(1 - served.mean())}
    mapped = pose.mapped
    shares = coverage(mapped.scene, camera)
    pixels = np.flatnonzero(shares["hair"])
    hits = find_hits(mapped, camera, pixels, HITS)
    radiance, known = interpolation.at_hits(hits).under_all(lights)
    hair = hits.column("weight").sum(axis=1)
    subject = np.maximum(hair + shares["head"].ravel()[pixels], 1e-6)
    left = np.clip(1 - known / subject, 0, 1)
    flat[pixels] = known[:, None] * radiance + left[:, None] * flat[pixels]
    return image, {"hair_unseen": float(1 - known.sum() / max(float(hair.sum()), 1e-6))}


def _source(interpolation: Interpolation, camera: Camera) -> Any:
    """The captured view of `camera`, or None."""
    known = camera.to_dict()
    return next((s for s in interpolation.sources if s.view.camera.to_dict() == known), None)


def all_lights(lights: Sequence[Light], environments: Sequence[Environment]) -> list[Light]:
    """The lights for `with_samples` of lights and environment maps together."""
    parts = [small for light in lights for small in panel(light)]
    return parts + [light for e in environments for light in environment_lights(e)]


def environment_lights(environment: Environment, rows: int = ROWS) -> list[Light]:
    """Far lights of the map's total irradiance: one per lit cell of `rows` x 2 `rows`, in the
    direction of its radiance-weighted mean."""
    envmap = check_environment(environment.envmap, "environment")
    lit = _texels(replace(environment, envmap=subdivided(envmap, rows)))
    cells = [
        np.array_split(np.arange(n), m) for n, m in zip(lit[0].shape, (rows, 2 * rows), strict=True)
    ]
    return [
        light
        for r in cells[0]
        for c in cells[1]
        for light in _far(f"cell_{r[0]}_{c[0]}", *(x[np.ix_(r, c)] for x in lit))
    ]


def _texels(environment: Environment) -> tuple[Array, Array, Array]:
    """Solid angles `(h, w)` of a map's texels, radiance times these, and directions `(h, w, 3)`."""
    envmap = check_environment(environment.envmap, "environment").astype(float)
    height, width = envmap.shape[:2]
    edges = np.linspace(0, np.pi, height + 1)
    solid = (np.cos(edges[:-1]) - np.cos(edges[1:]))[:, None] * np.full(width, 2 * np.pi / width)
    theta = 0.5 * (edges[:-1] + edges[1:])[:, None]
    phi = 2 * np.pi * (0.5 - (np.arange(width) + 0.5) / width + environment.rotation_deg / 360)
    flat = np.sin(theta)
    up = np.broadcast_to(np.cos(theta), solid.shape)
    direction = np.stack([flat * np.cos(phi), flat * np.sin(phi), up], axis=-1)
    return solid, envmap * np.asarray(environment.weight, float) * solid[..., None], direction


def _far(name: str, weight: Array, colour: Array, direction: Array) -> list[Light]:
    total = colour.sum(axis=(0, 1))
    if not total.any():
        return []
    middle = (np.abs(colour).sum(-1, keepdims=True) * direction).sum(axis=(0, 1))
    length = float(np.linalg.norm(middle))
    if length < 1e-12:
        middle, length = direction[0, 0], 1.0
    return [Light(name, FAR * middle / length, total * FAR**2)]


def panel(light: Light, across: int = 3) -> list[Light]:
    """A rectangular light as `across`² smaller ones; other lights unchanged."""
    if light.size is None or light.orientation is None:
        return [light]
    at = (np.arange(across) + 0.5) / across - 0.5
    width, height = light.size
    return [
        replace(
            light,
            name=f"{light.name}_{i}_{j}",
            position=light.position + light.orientation.T @ np.array([x * width, y * height, 0]),
            intensity=light.intensity / across**2,
            size=(width / across, height / across),
        )
        for i, x in enumerate(at)
        for j, y in enumerate(at)
    ]
