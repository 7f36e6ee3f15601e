"""The fit of a field to a capture, on top of inverse rendering."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from appearance.bsdf.maps import MappedStrands
from appearance.fields.anchors import Grid, Places
from appearance.fields.fit import JUDGED, FieldFit, Monitor, fit_pictures
from appearance.fields.hits import RECORD, HitOptions, find_hits
from appearance.fields.options import FieldRequest
from appearance.fields.pictures import Pictures
from appearance.fields.validation import BLOCK
from appearance.observations import chosen, observe
from appearance.render.harmonics import count_of
from appearance.render.smoothed import olat_smoothed
from appearance.render.tracing import Sampling
from appearance.scene.hair_scene import HairScene
from reconstruction import Capture, Light, Model, ModelError, Progress
from reconstruction.arrays import Floats, Ints
from reconstruction.files.durable import writing
from reconstruction.report.progress import part_of
from reconstruction.report.report import free_memory


@dataclass(frozen=True, eq=False)
class Rendered:
    """The material of a capture's model: its `scene` with maps and without field.

    `lights` have fitted intensities; `mapped` are the scene's strands; `scale` is the exposure.
    """

    mapped: MappedStrands
    scene: HairScene
    lights: tuple[Light, ...]
    scale: float


def fit_field(
    training: Capture,
    model: Model,
    rendered: Rendered,
    request: FieldRequest,
    progress: Progress,
    seed: int = 0,
) -> FieldFit:
    """Fit a field to the frames of `training` under the lights of `rendered`.

    Hits and renderings are stored in the model's folder "work" while the fit runs: a killed one
    resumes after the last rendered view. Raises `ModelError` if no camera sees hair or memory is
    insufficient.
    """
    if request.field == "none":
        raise ValueError("the field 'none' cannot be fitted")
    rng, folder = np.random.default_rng(seed), model.work("field")
    strands, cameras = len(rendered.mapped.root_uv), training.rig.cameras
    _, most = request.resolved(len(cameras), strands)
    masks = {c.name: model.mask(c.name, "hair", training) for c in cameras}
    pixels = {name: chosen(mask, most, rng) for name, mask in masks.items() if mask.any()}
    if not pixels:
        raise ModelError(f"{model}: the hair masks of the training cameras are all empty")
    needed = memory_needed(
        [len(p) for p in pixels.values()], len(rendered.lights), strands, request
    )
    progress(f"needs about {needed:.1f} GB of memory beside the scene", 0.0)
    free = free_memory()
    if free is not None and needed > free:
        raise ModelError(
            f"{model}: a field of {len(rendered.lights)} lights needs about {needed:.1f} GB of "
            f"memory, {free:.1f} GB are free: lower the field's pixels ({most}), hits "
            f"({request.hits}) or lights ({len(rendered.lights)})"
        )
    views = []
    for i, (name, index) in enumerate(pixels.items()):
        progress(f"{name}: rendering {len(rendered.lights)} lights", 0.7 * i / len(pixels))
        views.append(_pictures(training, rendered, (name, index), request, folder, seed))
    options = replace(request.fit, kind=request.field)
    checkpoint = folder / f"{request.field}.checkpoint.npz"
    monitor = Monitor(part_of(progress, 0.7, 1.0), checkpoint)
    places = Places.of(rendered.mapped.root_uv)
    return fit_pictures(views, places, rendered.scale, options, monitor)


def _pictures(
    training: Capture,
    rendered: Rendered,
    view: tuple[str, Ints],
    request: FieldRequest,
    folder: Path,
    seed: int,
) -> Pictures:
    """One camera's images; the renderings are stored in `folder`."""
    name, index = view
    camera = training.rig.camera(name)
    hits = find_hits(rendered.mapped, camera, index, HitOptions(request.hits, seed), folder)
    sampling = Sampling(request.spp, request.max_depth, seed)
    key = hashlib.sha256(repr((asdict(sampling), camera.to_dict())).encode())
    for light in rendered.lights:
        key.update(repr(light.to_dict()).encode())
    for array in (index, *_materials(rendered.scene)):
        key.update(np.ascontiguousarray(array).tobytes())
    file = folder / f"{name}-{key.hexdigest()[:16]}-rendered.npy"
    if not file.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        size = (2, len(rendered.lights), len(index), 3)
        with writing(file) as part:
            made = np.lib.format.open_memmap(part, mode="w+", dtype=np.float32, shape=size)
            for k in range(2):
                half = replace(sampling, spp=-(-request.spp // 2), seed=2 * seed + k)
                made[k] = olat_smoothed(rendered.scene, camera, rendered.lights, half, pixels=index)
            made.flush()
    names = [light.name for light in rendered.lights]
    captured = observe(training, name, names, index)
    halves: Floats = np.load(file, mmap_mode="r")
    return Pictures(hits, rendered.lights, halves, captured.radiance, captured.valid)


def _materials(scene: HairScene) -> Sequence[Any]:
    """The arrays that a scene's renderings depend on."""
    parts: list[Any] = [np.array(scene.skin)]
    shapes = (scene.hair_shape, scene.head_shape, scene.hair_bsdf)
    for part in (x for x in shapes if x is not None):
        values = mi.traverse(part)
        parts += [np.array(values[k]) for k in sorted(values.keys()) if "face" not in k]
    return parts


def memory_needed(pixels: Sequence[int], lights: int, strands: int, request: FieldRequest) -> float:
    """Approximate GB of a fit beside the scene, by `pixels` of each view under `lights`."""
    folds, n = request.fit.folds, count_of(request.fit.degree)
    turning = sum((2 * k + 1) ** 2 for k in range(request.fit.degree + 1))
    hit = RECORD.itemsize + 2 * n * 8 + 8 * turning + 4 * n + 8
    pixel = request.hits * hit + folds * 3 * 4 * (n * (n + 1) // 2 + n) + 12 * 3 * lights
    judging = sum(min(p, JUDGED) for p in pixels) * 12 * 3 * lights
    coefficients = 4 * n**2 * 3 * sum(Grid.of(x, strands).count for x in request.fit.levels)
    at_once = min(max(1, BLOCK // coefficients), folds**2)
    view = max(pixels) * max(
        (3 * 8 * 8 + 4 * n * (n + 1) // 2) * lights, 2 * request.hits * n * 3 * 4 * at_once
    )
    fits = (16 * at_once + 3 * folds**2) * coefficients
    return (sum(pixels) * pixel + judging + view + fits) / 1e9
