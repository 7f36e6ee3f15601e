"""Benchmark: stage 1 on frames that Blender Cycles rendered, on the true strands."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from appearance.bsdf.maps import HairMaps, MappedStrands, scalp_coordinates
from appearance.inverse_rendering.loop import Stage1Options, run
from appearance.inverse_rendering.problem import Effort, Problem
from appearance.inverse_rendering.start import hair_inverse
from appearance.metrics.scores import Exposure, psnr
from appearance.observations import Observed
from appearance.render.coverage import coverage
from appearance.render.olat import render_olat
from appearance.scene.hair_appearance import HairAppearance
from appearance.scene.hair_scene import HairScene, build_scene
from appearance.sun_fit.fit import FitOptions
from reconstruction.arrays import Array
from reconstruction.capture.folder import Capture
from reconstruction.capture.import_folder import import_folder
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.strands import Strands
from reconstruction.report.report import Progress, Stage, silent
from reconstruction.tangents.line_evidence import half_sphere

HELD_CAMERAS = (0, 4)
HELD_LIGHTS = (1, 3, 5, 7, 9)
OPTIONS = Stage1Options(
    row="original",
    watched_views=6,
    effort=Effort(pixels=300, spp=384, gradient_spp=48, max_depth=12),
)
AFAR = HairAppearance((0.13, 0.15, 0.35), 0.42, 0.2)


def _some(o: Observed, most: int, seed: int) -> Observed:
    """A random part of a view's pixels, in image order."""
    keep = np.zeros(len(o.pixels), bool)
    keep[np.random.default_rng(seed).permutation(len(o.pixels))[:most]] = True
    return o.where(keep)


def fit_cycles(
    out: Path,
    folder: Path,
    *,
    afar: bool = False,
    options: Stage1Options = OPTIONS,
    pixels: int = 600,
    judged_spp: int = 512,
    progress: Progress = silent,
    seed: int = 0,
) -> dict[str, Any]:
    """Fit one colour from the frames and the true strands; write `appearance_cycles.json`.

    `folder` is what `import_folder` reads, with `strands_gt.npz`. Half of the lights and two
    cameras are held out. `params.json` is opened after the fit, to say how far off it is. `afar`
    starts from `AFAR` in place of Sun's roughness and colour, of which the roughness is a guess
    that happens to be right here: with five lights none lies near a mirror direction.
    """
    strands, head = _geometry(folder)
    with tempfile.TemporaryDirectory() as scratch:
        progress("reading the capture", 0.0)
        capture = import_folder(folder, Path(scratch) / "capture")
        guess = HairAppearance((0.1, 0.1, 0.1), 0.3, 0.2)
        scene = build_scene(strands, head, hair=guess)
        views = [_view(capture, scene, c, "hair", pixels, seed) for c in capture.rig.cameras]
        bare = [_view(capture, scene, c, "head", 60, seed) for c in capture.rig.cameras]
    train = [i for i in range(len(views)) if i not in HELD_CAMERAS]
    lights = [i for i in range(len(views[0].lights)) if i not in HELD_LIGHTS]
    hair = [_under(views[i], lights) for i in train]
    skin = [_under(bare[i], lights) for i in train if len(bare[i].pixels) >= 10]
    exposure = Exposure.of([o.radiance for o in hair])
    stage = Stage("start")
    quick = FitOptions(hair_pixels=300, roughness_cameras=3, colour_spp=8)
    start, albedo = hair_inverse(
        scene, hair, skin, options=quick, stage=stage, progress=progress, seed=seed
    )
    start = AFAR if afar else start
    mapped = MappedStrands.of(scene, strands, scalp_coordinates(strands, None))
    problem = Problem(mapped, hair, exposure.scale, albedo)
    found = run(problem, HairMaps.of(start), options=options, progress=progress, seed=seed)
    mean = np.mean([o.radiance.mean((0, 1)) for o in hair], axis=0)
    judged = [_under(views[i], list(HELD_LIGHTS)) for i in HELD_CAMERAS]
    scores = {"mean colour": _flat_score(judged, mean, exposure)}
    for name, maps in (("start", HairMaps.of(start)), ("original", found.maps)):
        progress(f"judging {name}", 0.9)
        painted = mapped.painted(maps).with_skin(albedo)
        scores[name] = _score(painted, judged, exposure, judged_spp, options, seed)
    true = json.loads((folder / "params.json").read_text())
    result = {
        "psnr_held_out": scores,
        "ended": found.ended,
        "steps": found.steps,
        "skin": albedo.tolist(),
        "warnings": stage.warnings,
        "start": _against(start, true),
        "stage1": _against(found.maps.mean(), true),
        "history": found.history,
    }
    out.mkdir(parents=True, exist_ok=True)
    name = "appearance_cycles_from_afar.json" if afar else "appearance_cycles.json"
    (out / name).write_text(json.dumps(result, indent=1) + "\n")
    return result


def _against(hair: HairAppearance, true: dict[str, Any]) -> dict[str, Any]:
    sigma_a = np.array(hair.sigma_a) / np.array(true["sigma_a"], float) - 1
    return {
        **hair.to_dict(),
        "beta_m_error": hair.beta_m / true["beta_m"] - 1,
        "beta_n_error": hair.beta_n / true["beta_n"] - 1,
        "sigma_a_error": sigma_a.tolist(),
    }


def _geometry(folder: Path) -> tuple[Strands, Mesh]:
    truth = np.load(folder / "strands_gt.npz")
    directions = np.concatenate([half_sphere(2000), -half_sphere(2000)])
    faces = ConvexHull(directions).simplices.astype(np.int64)
    head = Mesh(truth["head_center"] + truth["head_axes"] * directions, faces)
    return Strands(truth["points"], truth["offsets"], float(truth["radius"])), head


def _view(
    capture: Capture, scene: HairScene, camera: Camera, kind: str, most: int, seed: int
) -> Observed:
    """Pixels that are almost wholly hair, or head."""
    pixels = np.flatnonzero(coverage(scene, camera)[kind].ravel() > 0.95)
    names = [x.name for x in capture.rig.lights]
    radiance = capture.olat(camera.name, names)
    values = radiance.reshape(len(names), -1, 3)[:, pixels]
    whole = Observed(
        camera, tuple(capture.rig.lights), pixels, values, np.ones(values.shape[:2], bool)
    )
    return _some(whole, most, seed)


def _under(o: Observed, lights: list[int]) -> Observed:
    chosen = tuple(o.lights[i] for i in lights)
    return replace(o, lights=chosen, radiance=o.radiance[lights], valid=o.valid[lights])


def _score(
    scene: HairScene,
    views: list[Observed],
    exposure: Exposure,
    spp: int,
    options: Stage1Options,
    seed: int,
) -> float:
    values = []
    for k, o in enumerate(views):
        rendered = render_olat(
            scene,
            o.camera,
            o.lights,
            spp=spp,
            max_depth=options.effort.max_depth,
            pixels=o.pixels,
            seed=(seed << 8) + 177 + k,
        )
        values += [_psnr(a, b, exposure) for a, b in zip(rendered, o.radiance, strict=True)]
    return float(np.mean(values))


def _flat_score(views: list[Observed], colour: Array, exposure: Exposure) -> float:
    flat = [_psnr(np.broadcast_to(colour, x.shape), x, exposure) for o in views for x in o.radiance]
    return float(np.mean(flat))


def _psnr(image: NDArray[Any], truth: NDArray[Any], exposure: Exposure) -> float:
    return psnr(exposure(image)[None], exposure(truth)[None])
