"""The viewer's picture at rest beside the path tracer's, light by light.

Judged on pixels that hair covers more than half, exposed so that the 99th percentile of the
path tracer's is white.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from appearance import Exposure, HairScene, Sampling, psnr, render_environment, render_olat
from appearance.model.light_sums import weights_of_environment
from appearance.render.coverage import coverage
from appearance.render.environment import direct_environment
from appearance.render.environment_maps import environment_map
from benchmarks.viewer.page import Shown
from reconstruction import Camera, Light, Progress
from reconstruction.arrays import Array, Bools, Floats

STUDIO = "studio"
DEPTH = 24
"""Vertices that a path may have."""
DIRECT = 8
"""Times as many paths of direct light: they are short, and from behind few of them are bright."""
SAMPLED = 32, 8
"""Of the rig's lights that stand for the map, those that a path's first and later vertices ask."""

Halves = tuple[Floats, Floats]
"""Two independent pictures `(H, W, 3)` of one thing, radiance."""


@dataclass(frozen=True)
class Effort:
    """Pixels a side, paths a pixel of each of two pictures that the viewer is held against.

    Each is `over` x `over` pixels of the viewer's, of so many `samples`.
    """

    size: int = 128
    spp: int = 512
    over: int = 4
    samples: int = 24


@dataclass(frozen=True)
class Row:
    """A light: what the page is told, and the path tracer's direct and all light."""

    what: Any
    direct: Halves
    whole: Halves


def compare(
    shown: Shown, scene: HairScene, effort: Effort, progress: Progress
) -> Iterator[tuple[str, dict[str, float], Array]]:
    """Of one light after another its name, figures and a picture `(H, 4 W, 3)`, 8 bits: the path
    tracer's, the viewer's, then direct light of both."""
    camera = shown.camera(effort.size)
    hair = coverage(scene, camera)["hair"] > 0.5
    lit = None
    for k, (name, row) in enumerate(_traced(scene, camera, shown.lights(), effort)):
        progress(name, 0.2 * k)
        exposure = Exposure.of([_mean(row.whole)[hair]])
        if row.what != lit:
            shown.light(row.what)
            direct, whole = (
                shown.at_rest(effort.size, effort.over, effort.samples, a) for a in (0.0, None)
            )
            lit = row.what
        figures = {
            **_judged("", whole, row.whole, exposure, hair),
            **_judged("direct_", direct, row.direct, exposure, hair),
            "direct_share": float(_mean(row.direct)[hair].sum() / _mean(row.whole)[hair].sum()),
        }
        drawn = (_mean(row.whole), whole, _mean(row.direct), direct)
        picture = np.hstack([exposure(x) for x in drawn])
        yield name, figures, np.rint(255 * picture).astype(np.uint8)


def _judged(
    what: str, found: Floats, truth: Halves, exposure: Exposure, mask: Bools
) -> dict[str, float]:
    """PSNR without the path tracer's noise, by the product of both halves' errors; PSNR beside
    their mean; that mean's own; light over the path tracer's, and half of what the halves differ
    by, which is about the error of that."""
    one, other = (exposure(x) for x in truth)
    error = ((exposure(found) - one) * (exposure(found) - other))[mask].mean()
    return {
        f"{what}psnr_db": float(-10 * np.log10(max(error, 1e-10))),
        f"{what}psnr_with_noise_db": psnr(exposure(found), exposure(_mean(truth)), mask),
        # a half differs from the other by twice the error of their mean: 6 dB
        f"{what}path_tracer_itself_db": psnr(one, other, mask) + 6.02,
        f"{what}over_path_tracer": float(found[mask].sum() / _mean(truth)[mask].sum()),
        f"{what}over_error": float(
            abs(truth[0][mask].sum() - truth[1][mask].sum()) / 2 / _mean(truth)[mask].sum()
        ),
    }


def _mean(halves: Halves) -> Floats:
    return 0.5 * (halves[0] + halves[1])


def _traced(
    scene: HairScene, camera: Camera, lights: list[Light], effort: Effort
) -> Iterator[tuple[str, Row]]:
    """From before, from the side, from behind, an environment map, and that of the rig's lights."""
    ways = np.array([x.position / np.linalg.norm(x.position) for x in lights])
    eye = camera.center / np.linalg.norm(camera.center)
    places = {"front": eye, "side": np.cross(eye, [0, 0, 1.0]), "behind": -eye}
    numbers = {name: int((ways @ way).argmax()) for name, way in places.items()}
    environment = environment_map(STUDIO)

    def twice(render: Callable[[int, int, int], Floats]) -> tuple[Array, Array]:
        """Direct light and all light, two pictures of each `(2, ..., H, W, 3)`."""
        efforts = (1, DIRECT * effort.spp), (DEPTH, effort.spp)
        both = [np.array([render(depth, spp, seed) for seed in (1, 2)]) for depth, spp in efforts]
        return both[0], both[1]

    def single(depth: int, spp: int, seed: int) -> Floats:
        chosen = [lights[n] for n in numbers.values()]
        return render_olat(scene, camera, chosen, spp=spp, max_depth=depth, seed=seed)

    def mapped(depth: int, spp: int, seed: int) -> Floats:
        if depth == 1:
            return direct_environment(scene, camera, environment, spp, seed)
        return render_environment(scene, camera, environment, Sampling(spp, depth, seed))

    def summed(depth: int, spp: int, seed: int) -> Floats:
        weights = weights_of_environment(lights, environment).astype(np.float32)
        olat = render_olat(
            scene,
            camera,
            lights,
            spp=-(-spp // 4),
            max_depth=depth,
            seed=seed,
            first_lights=SAMPLED[0],
            deep_lights=SAMPLED[1],
        )
        return np.einsum("lhwc,lc->hwc", olat, weights)

    direct, whole = twice(single)
    for i, (name, number) in enumerate(numbers.items()):
        yield name, Row({number: [1, 1, 1]}, tuple(direct[:, i]), tuple(whole[:, i]))
    for name, render in ((STUDIO, mapped), (f"{STUDIO}, as lights", summed)):
        direct, whole = twice(render)
        yield name, Row(STUDIO, tuple(direct), tuple(whole))


def write(path: Any, picture: Array) -> None:
    """Write a picture of `compare` as a PNG."""
    cv2.imwrite(str(path), picture[..., ::-1])
