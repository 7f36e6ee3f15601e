"""The viewer's picture at rest beside the path tracer's, light by light.

Judged on pixels that hair covers more than half, exposed so that the 99th percentile of the
path tracer's is white.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from appearance import Exposure, HairScene, Sampling, psnr, render_environment, render_olat
from appearance.model.relight import environment_map
from appearance.render.coverage import coverage
from benchmarks.viewer.page import Shown
from reconstruction import Camera, Light, Progress
from reconstruction.arrays import Array, Bools, Floats

STUDIO = "studio"
DEPTH = 24
"""Vertices that a path may have."""


@dataclass(frozen=True)
class Effort:
    """Pixels a side, paths a pixel of what the viewer is held against.

    Each is `over` x `over` pixels of the viewer's, of so many `samples`.
    """

    size: int = 128
    spp: int = 1024
    over: int = 4
    samples: int = 24


@dataclass(frozen=True)
class Row:
    """A light: what the page is told, its path-traced direct light and two halves of all."""

    what: Any
    direct: Floats
    halves: tuple[Floats, Floats]

    @property
    def whole(self) -> Floats:
        """All light `(H, W, 3)`, radiance."""
        return 0.5 * (self.halves[0] + self.halves[1])


def compare(
    shown: Shown, scene: HairScene, effort: Effort, progress: Progress
) -> tuple[dict[str, dict[str, float]], Array]:
    """Figures by light, and a picture `(H, W, 3)`, 8 bits: each light a row, the path tracer's, the
    viewer's, then direct light of both."""
    camera = shown.camera(effort.size)
    hair = coverage(scene, camera)["hair"] > 0.5
    figures: dict[str, dict[str, float]] = {}
    pictures = list[Array]()
    for name, row in _traced(scene, camera, shown.lights(), effort).items():
        progress(name, 0.2 * len(figures))
        exposure = Exposure.of([row.whole[hair]])
        shown.light(row.what)
        direct, whole = (
            shown.at_rest(effort.size, effort.over, effort.samples, a) for a in (0.0, None)
        )
        figures[name] = {
            "psnr_db": psnr(exposure(whole), exposure(row.whole), hair),
            "over_path_tracer": _ratio(whole, row.whole, hair),
            "direct_psnr_db": psnr(exposure(direct), exposure(row.direct), hair),
            "direct_over_depth_1": _ratio(direct, row.direct, hair),
            "direct_share": _ratio(row.direct, row.whole, hair),
            # a half differs from the other by twice the error of their mean: 6 dB
            "path_tracer_itself_db": psnr(exposure(row.halves[0]), exposure(row.halves[1]), hair)
            + 6.02,
        }
        pictures.append(np.hstack([exposure(x) for x in (row.whole, whole, row.direct, direct)]))
    return figures, np.rint(255 * np.vstack(pictures)).astype(np.uint8)


def _ratio(found: Floats, truth: Floats, mask: Bools) -> float:
    return float(found[mask].sum() / truth[mask].sum())


def _traced(
    scene: HairScene, camera: Camera, lights: list[Light], effort: Effort
) -> dict[str, Row]:
    """From before, from the side, from behind, and an environment map."""
    ways = np.array([x.position / np.linalg.norm(x.position) for x in lights])
    eye = camera.center / np.linalg.norm(camera.center)
    places = {"front": eye, "side": np.cross(eye, [0, 0, 1.0]), "behind": -eye}
    numbers = {name: int((ways @ way).argmax()) for name, way in places.items()}
    chosen = [lights[n] for n in numbers.values()]

    def olat(depth: int, spp: int, seed: int) -> Floats:
        return render_olat(scene, camera, chosen, spp=spp, max_depth=depth, seed=seed)

    def studio(depth: int, spp: int, seed: int) -> Floats:
        sampling = Sampling(spp, depth, seed)
        return render_environment(scene, camera, environment_map(STUDIO), sampling)

    half = effort.spp // 2
    direct, one, other = olat(1, effort.spp, 1), olat(DEPTH, half, 2), olat(DEPTH, half, 3)
    rows = {
        name: Row({number: [1, 1, 1]}, direct[i], (one[i], other[i]))
        for i, (name, number) in enumerate(numbers.items())
    }
    halves = studio(DEPTH, half, 2), studio(DEPTH, half, 3)
    return {**rows, STUDIO: Row(STUDIO, studio(1, effort.spp, 1), halves)}


def write(path: Any, picture: Array) -> None:
    """Write a picture of `compare` as a PNG."""
    cv2.imwrite(str(path), picture[..., ::-1])
