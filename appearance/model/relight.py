"""A fitted model under another light: the relit picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from appearance.metrics.pictures import write_png
from appearance.metrics.scores import Exposure
from appearance.model.fitted_appearance import FittedAppearance
from appearance.render.coverage import coverage
from appearance.render.environment_maps import load_environment, sky, studio
from appearance.render.smoothed import environment_smoothed
from appearance.scene.hair_scene import build_scene
from reconstruction.arrays import Floats
from reconstruction.files.exr import write_exr
from reconstruction.files.strands import read_strands
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.strands import Strands

PROCEDURAL = {"studio": studio, "sky": sky}


def relight_model(
    model: Path,
    head: Mesh | None,
    *,
    environment: str | Path | None = None,
    size: int = 320,
    spp: int = 36,
    seed: int = 0,
) -> Floats:
    """Render a model in three-quarter view under `environment`: radiance `(size, size, 3)`.

    `environment` is "studio" (the default), "sky" or the path of an `.hdr` or `.exr` map. Writes
    `relit.exr` (radiance) and `relit.png` (the subject's 99th percentile at white, sRGB) into the
    folder `model`, which holds `strands.npz` and `appearance.json`.
    """
    fitted = FittedAppearance.load(model)
    strands = read_strands(model / "strands.npz")
    scene = build_scene(strands, head, hair=fitted.hair, skin=fitted.skin)
    camera = three_quarter_view(strands, size)
    procedural = PROCEDURAL.get(str(environment or "studio"))
    envmap = procedural() if procedural else load_environment(Path(str(environment)))
    radiance = environment_smoothed(scene, camera, envmap, spp=spp, seed=seed)
    share = coverage(scene, camera)
    subject = share["hair"] + share["head"] > 0.5
    write_exr(model / "relit.exr", radiance)
    write_png(model / "relit.png", Exposure.of([radiance[subject]])(radiance))
    return radiance


def three_quarter_view(strands: Strands, size: int) -> Camera:
    """A camera of `size`² pixels that sees all of `strands` from the front left, slightly above.

    The face looks along −y, as everywhere in this project.
    """
    low, high = strands.points.min(axis=0).astype(float), strands.points.max(axis=0).astype(float)
    middle, reach = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    direction = np.array([0.62, -0.75, 0.22])
    distance = 6.0 * reach
    position = middle + distance * direction / np.linalg.norm(direction)
    fov = float(np.degrees(2 * np.arcsin(0.85 * reach / distance)))
    return Camera.look_at("three_quarter", size, size, position, middle, fov)
