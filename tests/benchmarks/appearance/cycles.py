"""Inverse rendering of frames that Blender Cycles rendered, on the true strands."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from appearance import (
    Exposure,
    HairAppearance,
    HairScene,
    InverseRenderingOptions,
    build_scene,
    psnr,
    render_olat,
)
from appearance.bsdf.maps import HairMaps, MappedStrands, scalp_coordinates
from appearance.inverse_rendering.loop import Monitor, run
from appearance.inverse_rendering.options import Effort
from appearance.inverse_rendering.problem import FitProblem
from appearance.observations import Observed
from appearance.render.coverage import coverage
from appearance.sun_fit.options import FitOptions
from benchmarks.appearance.hair_inverse import hair_inverse
from benchmarks.appearance.known_subjects import JUDGED_VIEW, Captured, SmallStage
from benchmarks.subjects import Subject, cycles_subject
from reconstruction import Camera, Capture, Progress, Stage, import_folder, silent
from reconstruction.arrays import AnyFloats

HELD_CAMERAS = (0, 4)
HELD_LIGHTS = (1, 3, 5, 7, 9)
OPTIONS = InverseRenderingOptions(
    free_index=True,
    effort=Effort(pixels=300, spp=384, max_depth=12),
)
_PIXELS = 1500
AFAR = HairAppearance((0.13, 0.15, 0.35), 0.42, 0.2)


@dataclass(frozen=True)
class CyclesFrames:
    """The capture that Cycles rendered, on its true strands.

    `hair` and `skin` are what a fit sees, `held` what it is judged by: half of the lights and two
    cameras. `truth` is `params.json`, to say how far off a fit is.
    """

    subject: Subject
    scene: HairScene
    hair: list[Observed]
    skin: list[Observed]
    held: list[Observed]
    truth: dict[str, Any]
    seed: int

    @classmethod
    def read(cls, folder: Path, *, pixels: int = 600, seed: int = 0) -> CyclesFrames:
        """Read `folder`, which is what `import_folder` reads with its truth."""
        subject, truth = cycles_subject(folder)
        guess = HairAppearance((0.1, 0.1, 0.1), 0.3, 0.2)
        scene = build_scene(subject.strands, subject.head, hair=guess)
        with tempfile.TemporaryDirectory() as scratch:
            capture = import_folder(folder, Path(scratch) / "capture")
            hair, skin = (
                [_view(capture, scene, c, kind, most, seed) for c in capture.rig.cameras]
                for kind, most in (("hair", pixels), ("head", 60))
            )
        train = [i for i in range(len(hair)) if i not in HELD_CAMERAS]
        lights = [i for i in range(len(hair[0].lights)) if i not in HELD_LIGHTS]
        return cls(
            subject,
            scene,
            [_under(hair[i], lights) for i in train],
            [_under(skin[i], lights) for i in train if len(skin[i].pixels) >= 10],
            [_under(hair[i], HELD_LIGHTS) for i in HELD_CAMERAS],
            truth,
            seed,
        )


def captured_by_cycles(folder: Path, seed: int = 0) -> Captured:
    """The capture as a subject of known appearance: one colour, on its true strands.

    Pictures are judged by the held-out lights, in the held-out cameras and a training one.
    """
    subject, _ = cycles_subject(folder)
    scene = subject.scene()
    with tempfile.TemporaryDirectory() as scratch:
        capture = import_folder(folder, Path(scratch) / "capture")
        views = [_view(capture, scene, c, "hair", _PIXELS, seed) for c in capture.rig.cameras]
    mapped = MappedStrands.of(scene, subject.strands, scalp_coordinates(subject.strands, None))
    held_views = set(HELD_CAMERAS)
    return Captured(
        mapped,
        mapped,
        HairMaps.of(subject.hair),
        np.array(subject.skin),
        tuple(views),
        # frames are there once: their noise is taken for error
        tuple((o.radiance, o.radiance) for o in views),
        HELD_CAMERAS,
        HELD_LIGHTS,
        Exposure.of([o.radiance[::2] for i, o in enumerate(views) if i not in held_views]),
        SmallStage(192, len(views), len(views[0].lights), judged_spp=512, max_depth=12),
        tuple((k, i) for k in (*HELD_CAMERAS, JUDGED_VIEW) for i in HELD_LIGHTS),
    )


def fit_cycles(
    frames: CyclesFrames,
    start: HairAppearance | None = None,
    *,
    options: InverseRenderingOptions = OPTIONS,
    judged_spp: int = 512,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Fit one colour; held-out scores, and how far off start and end are.

    From `start` in place of Sun's roughness and colour, of which the roughness is a guess that
    happens to be right here: with five lights none lies near a mirror direction.
    """
    exposure = Exposure.of([o.radiance for o in frames.hair])
    stage = Stage("start")
    quick = FitOptions(hair_pixels=300, roughness_cameras=3, colour_spp=8)
    found_start, albedo = hair_inverse(
        frames.scene,
        frames.hair,
        frames.skin,
        options=quick,
        stage=stage,
        progress=progress,
        seed=frames.seed,
    )
    start = start or found_start
    strands = frames.subject.strands
    mapped = MappedStrands.of(frames.scene, strands, scalp_coordinates(strands, None))
    problem = FitProblem(mapped, frames.hair, exposure.scale, albedo)
    found = run(
        problem,
        HairMaps.of(start),
        stages=("shared",),
        options=options,
        monitor=Monitor(progress),
        seed=frames.seed,
    )
    mean = np.mean([o.radiance.mean((0, 1)) for o in frames.hair], axis=0)
    flat = [np.broadcast_to(mean, o.radiance.shape) for o in frames.held]
    scores = {"mean colour": _psnr(flat, frames.held, exposure)}
    for name, maps in (("start", HairMaps.of(start)), ("shared", found.maps)):
        progress(f"judging {name}", 0.9)
        scene = mapped.with_maps(maps).with_skin(albedo)
        pictures = [
            render_olat(
                scene,
                o.camera,
                o.lights,
                spp=judged_spp,
                max_depth=options.effort.max_depth,
                pixels=o.pixels,
                seed=(frames.seed << 8) + 177 + k,
            )
            for k, o in enumerate(frames.held)
        ]
        scores[name] = _psnr(pictures, frames.held, exposure)
    return {
        "psnr_held_out": scores,
        "decision": found.decisions[0].to_dict(),
        "skin": albedo.tolist(),
        "warnings": stage.warnings,
        "start": _against(start, frames.truth),
        "found": _against(found.maps.mean(), frames.truth),
    }


def _against(hair: HairAppearance, true: dict[str, Any]) -> dict[str, Any]:
    sigma_a = np.array(hair.sigma_a) / np.array(true["sigma_a"], float) - 1
    return {
        **hair.to_dict(),
        "beta_m_error": hair.beta_m / true["beta_m"] - 1,
        "beta_n_error": hair.beta_n / true["beta_n"] - 1,
        "sigma_a_error": sigma_a.tolist(),
    }


def _view(
    capture: Capture, scene: HairScene, camera: Camera, kind: str, most: int, seed: int
) -> Observed:
    """Pixels that are almost wholly hair, or head."""
    pixels = np.flatnonzero(coverage(scene, camera)[kind].ravel() > 0.95)
    names = [x.name for x in capture.rig.lights]
    radiance, _ = capture.olat(camera.name, names)
    values = radiance.reshape(len(names), -1, 3)[:, pixels]
    whole = Observed(
        camera, tuple(capture.rig.lights), pixels, values, np.ones(values.shape[:2], bool)
    )
    keep = np.zeros(len(pixels), bool)
    keep[np.random.default_rng(seed).permutation(len(pixels))[:most]] = True
    return whole.where(keep)


def _under(o: Observed, lights: Sequence[int]) -> Observed:
    chosen, at = tuple(o.lights[i] for i in lights), list(lights)
    return replace(o, lights=chosen, radiance=o.radiance[at], valid=o.valid[at])


def _psnr(pictures: Sequence[AnyFloats], views: Sequence[Observed], exposure: Exposure) -> float:
    """Mean over views and lights of `pictures`, each `(L, P, 3)`."""
    found = [
        psnr(exposure(a)[None], exposure(b)[None])
        for picture, o in zip(pictures, views, strict=True)
        for a, b in zip(picture, o.radiance, strict=True)
    ]
    return float(np.mean(found))
