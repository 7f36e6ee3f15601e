"""What Dr.Jit runs, as jobs that one back end does at a time.

Each is done twice: the first time, kernels are compiled too.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from appearance import InverseRenderingOptions, render_olat
from appearance.bsdf import lobes, reference
from appearance.metrics.decision import MATERIAL
from appearance.scene.backend import ensure_backend
from benchmarks.appearance.known_subjects import SmallStage, known_subject
from benchmarks.appearance.table import GROUPS, Table
from benchmarks.bsdf.integrals import array_types
from benchmarks.renderers.cost import View
from benchmarks.renderers.errors import dome
from benchmarks.subjects import Subject
from reconstruction import Camera
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import Array, Floats
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.light_codes.code_views import View as LineView
from reconstruction.light_codes.depth_range import depth_range
from reconstruction.light_codes.search import DepthMap, DepthSearch
from reconstruction.light_codes.segments import count_supports, to_segments
from reconstruction.reconstruct_options import SearchOptions


@dataclass(frozen=True)
class Done:
    """What a back end made of a job.

    `first` and `seconds`: of the first time and of the second (the only one where there is but
    one). `values` are compared with another back end's, number by number; `figures` are not.
    """

    first: float
    seconds: float
    values: Floats
    figures: dict[str, float]


def bsdf(lanes: int, seed: int) -> Done:
    """Evaluate and sample the BSDF for `lanes` fibres and directions; values of the first 10,000.

    Roughness from 0.01 to 0.9, all offsets and directions.
    """
    ensure_backend()
    number, vector = array_types(False)
    rng = np.random.default_rng(seed)

    def column(values: Array) -> Any:
        return number(for_kernels(values))

    def directions() -> Any:
        theta, phi = np.arcsin(rng.uniform(-1, 1, lanes)), rng.uniform(-np.pi, np.pi, lanes)
        return vector(*map(column, reference.direction(theta, phi).T))

    wi, wo = directions(), directions()
    fibre = lobes.Fibre(
        vector(*(column(rng.uniform(0, 3, lanes)) for _ in "rgb")),
        beta_m=column(rng.uniform(0.01, 0.9, lanes)),
        beta_n=column(rng.uniform(0.01, 0.9, lanes)),
        eta=column(rng.uniform(1.3, 1.8, lanes)),
        tilt=column(rng.uniform(-0.1, 0.1, lanes)),
    )
    u = [column(rng.random(lanes)) for _ in range(3)]
    dr.eval(wi, wo, fibre.sigma_a, fibre.beta_m, fibre.beta_n, fibre.eta, fibre.tilt, *u)

    def work() -> Any:
        value, pdf = lobes.evaluate(fibre, wi, wo)
        drawn, density, weight = lobes.sample(fibre, wi, *u)
        dr.eval(value, pdf, drawn, density, weight)
        return value, pdf

    first, seconds, (value, pdf) = _twice(work)
    values = np.stack([np.array(x)[:10_000] for x in (*value, pdf)])
    return Done(first, seconds, values, {"million_lanes_a_second": lanes / seconds / 1e6})


def olat(subject: Subject, camera: Camera, pixels: int, lights: int, spp: int, seed: int) -> Done:
    """Render `pixels` of hair under `lights` of a dome.

    `noise`: relative RMS by which two renderings with other random numbers differ.
    """
    ensure_backend()
    view, lamps = View.of(subject, camera, pixels, seed), dome(lights, seed)
    pictures: list[Floats] = []

    def work() -> Floats:
        pictures.append(
            render_olat(
                view.scene, camera, lamps, pixels=view.index, spp=spp, seed=seed + len(pictures)
            )
        )
        return pictures[0]

    first, seconds, picture = _twice(work)
    mean = float(picture.mean())
    noise = float(np.sqrt(np.mean((pictures[0] - pictures[1]) ** 2) / 2)) / mean
    return Done(first, seconds, picture, {"mean": mean, "noise": noise})


def fit(subject: Subject, stage: SmallStage, options: InverseRenderingOptions, seed: int) -> Done:
    """The ladder of stage 1 on the frames of subject (b), once.

    `values` are the frames' means by view and light; the last variant's errors are figures.
    """
    ensure_backend()
    begun = time.perf_counter()
    captured = known_subject("b", subject, stage, seed)
    frames = time.perf_counter() - begun
    table = Table(captured, options, seed=seed)
    begun = time.perf_counter()
    variants = table.run()
    seconds = time.perf_counter() - begun
    last = variants[MATERIAL[-1]]
    figures = {n: float(last[n]) for n in ("beta_m_error", "beta_n_error", "sigma_a_error")}
    figures |= {"psnr_clean": last[GROUPS[1]]["psnr_clean"], "frames_seconds": frames}
    means = np.stack([o.radiance.mean((1, 2)) for o in captured.views])
    return Done(seconds, seconds, means, figures)


def search(views: Sequence[LineView], volume: VoxelGrid, options: SearchOptions) -> Done:
    """Line stereo's depths in every view, NaN where none was found, and the segments' supports."""
    ranges = [depth_range(v.camera, volume) for v in views]

    def work() -> tuple[list[DepthMap], Any]:
        searching = DepthSearch(views, volume.centers().mean(axis=0), options)
        maps = [searching.run(k, *r) for k, r in enumerate(ranges)]
        return maps, count_supports(views, maps, to_segments(views, maps))

    first, seconds, (maps, segments) = _twice(work)
    depths = [np.full((v.camera.height, v.camera.width), np.nan, np.float32) for v in views]
    for depth, found in zip(depths, maps, strict=True):
        depth[found.y, found.x] = found.depth
    supported = float(np.mean(segments.supports >= 3))
    figures = {"segments": float(len(segments)), "seen_by_three": supported}
    return Done(first, seconds, np.concatenate([d.ravel() for d in depths]), figures)


def _twice(work: Callable[[], Any]) -> tuple[float, float, Any]:
    """Seconds of the first and of the second time, and what came of it."""
    times = []
    for _ in range(2):
        dr.sync_thread()
        begun = time.perf_counter()
        found = work()
        dr.sync_thread()
        times.append(time.perf_counter() - begun)
    return times[0], times[1], found
