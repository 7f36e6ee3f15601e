"""Views of the hair from a capture's single-light frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from reconstruction.arrays import Bools
from reconstruction.capture.folder import Capture, CaptureError
from reconstruction.geometry.cameras import Camera
from reconstruction.images.orientation import orientations
from reconstruction.images.silhouettes import background_noise, dark_frame
from reconstruction.light_codes.code_views import View, furthest_light, light_beside, line_vectors
from reconstruction.light_codes.codes import along_lines, code_map
from reconstruction.reconstruct_options import LogGaborBank
from reconstruction.report.report import Progress, Stage, silent


def views_of(
    capture: Capture,
    hair: Mapping[str, Bools],
    subject: Any,
    bank: LogGaborBank,
    stage: Stage | None = None,
    progress: Progress = silent,
) -> list[View]:
    """A view for each camera with hair on its mask `hair[name] (H, W)`.

    Lights are weighed so that each gives the same irradiance at `subject (3,)`, metres. Reports how
    many lights vary, thresholds, and which cameras no light stands beside. Raises `CaptureError`
    without single-light frames, or where fewer than two cameras see hair.
    """
    stage = stage or Stage("lightcodes")
    names = capture.olat_lights()
    if not names:
        raise CaptureError(f"{capture.path}: no OLAT frames, which lines and lightcodes come from")
    cameras = [c for c in capture.rig.cameras if c.name in hair and hair[c.name].any()]
    if len(cameras) < 2:
        raise CaptureError(
            f"{capture.path}: hair is on the masks of {[c.name for c in cameras]}: line stereo "
            "needs two cameras that see it; check the masks"
        )
    views = []
    for done, camera in enumerate(cameras):
        progress("lines and lightcodes", done / len(cameras))
        views.append(_view(capture, camera, names, hair[camera.name], subject, bank))
    alone = [v.camera.name for v in views if v.beside < 0]
    stage.figures.update(
        lights=len(names),
        cameras_with_a_light_beside=len(views) - len(alone),
        varying_lights={v.camera.name: int(np.bitwise_count(v.codes.varying).sum()) for v in views},
        threshold={v.camera.name: v.codes.threshold for v in views},
        confidence={v.camera.name: float(np.median(v.confidence[v.mask])) for v in views},
    )
    if alone:
        stage.warn(
            f"no light stands beside {alone}: whether they see a pixel is not known from its "
            "lightcode, only from where they stand"
        )
    if not any(v.codes.varying.any() for v in views):
        stage.warn(
            "no light tells one hair pixel from another: lightcodes match everywhere, and depths "
            "come from lines alone"
        )
    if not any((v.confidence > 0).any() for v in views):
        raise CaptureError(
            f"{capture.path}: no hair pixel has a direction: are the OLAT frames in focus and lit?"
        )
    return views


def _view(
    capture: Capture,
    camera: Camera,
    names: Sequence[str],
    mask: Bools,
    subject: Any,
    bank: LogGaborBank,
) -> View:
    at = np.asarray(subject, float)
    lights = [capture.rig.light(n) for n in names]
    images = np.empty((len(names), camera.height, camera.width), np.float32)
    clipped = np.zeros(images.shape, bool)
    noise = 0.0
    dark = dark_frame(capture, camera.name)
    for i, (name, light) in enumerate(zip(names, lights, strict=True)):
        image, clipped[i] = capture.light(name, camera.name)
        irradiance = float(light.intensity_towards(at).mean())
        irradiance /= float(((light.position - at) ** 2).sum())
        if irradiance <= 0:
            raise CaptureError(
                f"{capture.path}: the light {name} sends nothing towards {at.tolist()}: check its "
                "intensity and aim in rig.json"
            )
        images[i] = (image.mean(axis=-1) - dark) / irradiance
        noise = max(noise, background_noise(images[i]))
    found = orientations(images, mask, bank)
    smooth = along_lines(images, found.angle)
    codes = code_map(smooth, mask, furthest_light(camera, lights), noise, clipped)
    lines = line_vectors(found.angle, found.confidence)
    return View(camera, mask, lines, codes, light_beside(camera, lights, at))
