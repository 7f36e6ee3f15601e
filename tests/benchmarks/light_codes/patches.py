"""Line stereo on patches whose truth is known: quality, how it falls with cameras and lights."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from benchmarks.light_codes.study import compare_filters, study_depths
from benchmarks.pictures import picture_strands
from reconstruction.arrays import AnyFloats, Bools
from reconstruction.capture.folder import Capture, CaptureError
from reconstruction.capture.import_folder import import_folder
from reconstruction.evaluation.baselines import baseline_hull, hull_smooth_field, hull_vertical
from reconstruction.evaluation.matching import compare_strands
from reconstruction.evaluation.visibility import Visibility
from reconstruction.files.strands import read_strands
from reconstruction.geometry.mesh_queries import mesh_depth
from reconstruction.geometry.strands import Strands
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.images.orientation import texture
from reconstruction.light_codes.measure_segments import build_views
from reconstruction.masks import hair_masks
from reconstruction.methods import Method
from reconstruction.model import Model
from reconstruction.pipeline import ReconstructOptions, reconstruct
from reconstruction.report.plots import plot_geometry, plot_report
from reconstruction.report.report import Progress, Report, Series, silent

SUN = {
    "Nam 2019, short hair": (6.56, 20.94, 37.32),
    "Sun 2021, short hair": (22.42, 59.22, 79.35),
    "Nam 2019, long hair": (6.87, 16.70, 27.95),
    "Sun 2021, long hair": (28.22, 65.52, 80.60),
}
"""F in per cent of Sun's Table 1 at 1 mm/10°, 2 mm/20° and 3 mm/30°."""

METHODS: tuple[Method, ...] = ("lmvs", "photometric", "fused")
CAMERAS, LIGHTS = (12, 6), (18, 9)

STEP = 5e-4
"""Metres between the points at which strands are cut at the ball's surface."""


def cut_to_ball(strands: Strands, center: ArrayLike, radius: float) -> Strands:
    """The pieces of the strands that lie in a ball, resampled at half a millimetre."""
    dense = strands.resampled(STEP)
    inside = np.linalg.norm(dense.points - np.asarray(center), axis=1) < radius
    owner = dense.strand_of_point
    starts = inside & ~np.r_[False, inside[:-1] & (owner[1:] == owner[:-1])]
    piece = np.cumsum(starts)[inside]
    points = dense.points[inside]
    count = np.bincount(piece)[1:] if len(piece) else np.zeros(0, np.int64)
    keep = np.repeat(count >= 2, count)
    offsets = np.concatenate([[0], np.cumsum(count[count >= 2])]).astype(np.int64)
    return Strands(points[keep], offsets, float(np.mean(strands.radius)))


class PatchTruth:
    """True strands within a ball, and what the capture's cameras see of them."""

    def __init__(
        self, capture: Capture, folder: Path, center: ArrayLike, radius: float, samples: int
    ) -> None:
        whole = read_strands(folder / "strands.npz")
        self.cameras, self.head = capture.rig.cameras, capture.head
        self.center, self.radius, self.samples = center, radius, samples
        self.strands = cut_to_ball(whole, center, radius)
        self.visibility = Visibility(self.cameras, whole, self.head)

    def score(self, strands: Strands) -> dict[str, Any]:
        """`compare_strands` of what lies in the ball, over visible and all."""
        return compare_strands(
            cut_to_ball(strands, self.center, self.radius),
            self.strands,
            cameras=self.cameras,
            head=self.head,
            samples=self.samples,
            visibility=self.visibility,
        )


def write_hair_masks(capture: Capture, truth_folder: Path) -> None:
    """Write the user's masks of a capture that has none, from its true strands.

    Sun's come from a network trained for it; a patch has no background by which to tell hair.
    """
    strands = read_strands(truth_folder / "strands.npz")
    points = strands.resampled(STEP).points
    (capture.path / "masks").mkdir(exist_ok=True)
    for camera in capture.rig.cameras:
        file = capture.path / "masks" / f"{camera.name}.png"
        if file.exists():
            continue
        pixels, depth = camera.project(points)
        on = (depth > 0) & camera.inside(pixels)
        x, y = np.rint(pixels[on]).astype(int).T
        nearest = np.full((camera.height, camera.width), np.inf)
        np.minimum.at(nearest, (y, x), depth[on])
        nearest = ndimage.minimum_filter(nearest, 3)  # strands are two to three pixels wide
        skin = np.inf if capture.head is None else mesh_depth(camera, capture.head)
        cv2.imwrite(str(file), (nearest < skin).astype(np.uint8) * 255)


def part_of(capture: Capture, cameras: int | None = None, lights: int | None = None) -> Capture:
    """The capture with `cameras` and `lights` of it, evenly picked in the rig's order."""
    some = [c.name for c in _every(capture.rig.cameras, cameras)]
    return capture.view(cameras=some, lights=_every(capture.olat_lights(), lights))


def _every(items: Sequence[Any], count: int | None) -> list[Any]:
    if count is None or count >= len(items):
        return list(items)
    return [items[int(i)] for i in np.linspace(0, len(items) - 1, count).round()]


def run_patch(
    out: Path,
    capture_folder: Path,
    truth_folder: Path,
    center: ArrayLike,
    radius: float,
    *,
    options: ReconstructOptions | None = None,
    thinner: bool = True,
    samples: int = 10_000,
    progress: Progress = silent,
) -> dict[str, Any]:
    """All methods and both baselines in a ball about `center (3,)` of `radius` metres.

    `thinner` also runs `photometric` with fewer cameras and with fewer lights, and `study`. Models
    are left in `OUT/<method>`, figures in `OUT/patch.json` as they come.
    """
    options = options or ReconstructOptions()
    capture = Capture(capture_folder)
    write_hair_masks(capture, truth_folder)
    truth = PatchTruth(capture, truth_folder, center, radius, samples)
    runs: list[tuple[str, Method, Capture]] = [(m, m, capture) for m in METHODS]
    if thinner:
        for n in CAMERAS:
            runs.append((f"photometric, {n} cameras", "photometric", part_of(capture, cameras=n)))
        for n in LIGHTS:
            runs.append((f"photometric, {n} lights", "photometric", part_of(capture, lights=n)))
    results: dict[str, Any] = {"rows": {}, "sun": SUN}
    for k, (name, method, some) in enumerate(runs):
        model = out / name.replace(", ", "_").replace(" ", "_")
        begin = time.perf_counter(), time.process_time()
        report = reconstruct(
            some,
            Model(model),
            method=method,
            options=options,
            progress=lambda what, share, k=k, n=name: progress(  # type: ignore[misc]
                f"{n}: {what}", (k + share) / (len(runs) + 1)
            ),
        )
        row = truth.score(read_strands(model / "strands.npz"))
        results["rows"][name] = {
            **row,
            "seconds": time.perf_counter() - begin[0],
            "cpu_seconds": time.process_time() - begin[1],
            "stages": _stages(report),
        }
        _save(out / "patch.json", results)
    if thinner:
        progress("error against run time", len(runs) / (len(runs) + 1))
        results["study"], results["filters"] = study(capture, truth.strands, options, out)
        _save(out / "patch.json", results)
    progress("baselines", len(runs) / (len(runs) + 1))
    ball = (center, radius + options.grid)
    for name, strands in baselines(capture, out / "photometric", options.grid, ball).items():
        results["rows"][name] = truth.score(strands)
    _save(out / "patch.json", results)
    plot_geometry(results["rows"], out / "patch.png")
    found: dict[str, Strands] = {m: read_strands(out / m / "strands.npz") for m in METHODS}
    everything: dict[str, Strands] = {"true": truth.strands, **found}
    picture_strands(
        out / "strands.png",
        capture.rig.cameras[0],
        {k: cut_to_ball(s, center, radius) for k, s in everything.items()},
    )
    return results


def study(
    capture: Capture, truth: Strands, options: ReconstructOptions, out: Path
) -> tuple[dict[str, Any], dict[str, float]]:
    """What the depth search finds against what it costs, and the filter bank beside OpenCV's loop.

    On every eighth view. Also drawn, as `OUT/study/error_*.png`.
    """
    codes = options.light_codes
    masks = hair_masks(capture, None, capture.head)
    views, volume = build_views(capture, masks, capture.head, Report(), options=codes)
    found = study_depths(views, volume, truth, codes, range(1, len(views), 8))
    report = Report()
    for name, variants in found.items():
        with report.stage(name) as stage:
            points = [(v["seconds"], 1 - v["right"]) for v in variants.values()]
            stage.series.append(Series(name, "share of pixels that are wrong", points))
    plot_report(report, out / "study")
    camera = capture.rig.cameras[0]
    image, _ = capture.light(capture.olat_lights()[0], camera.name)
    pixels = texture(image.mean(axis=-1), masks[camera.name].hair)
    return found, compare_filters(codes.bank, pixels)


def run_imported(
    out: Path,
    folder: Path,
    *,
    options: ReconstructOptions | None = None,
    samples: int = 10_000,
    progress: Progress = silent,
) -> dict[str, Any]:
    """All methods on a folder that `import_folder` reads, with true strands `strands_gt.npz`.

    A method that needs what the capture lacks has its reason under "left_out" and no row.
    """
    options = options or ReconstructOptions()
    shutil.rmtree(out / "capture", ignore_errors=True)
    capture = import_folder(folder, out / "capture")
    truth = read_strands(folder / "strands_gt.npz")
    results: dict[str, Any] = {"rows": {}, "left_out": {}}
    for method in METHODS:
        try:
            reconstruct(
                capture, Model(out / method), method=method, options=options, progress=progress
            )
        except CaptureError as error:
            results["left_out"][method] = str(error)
            continue
        results["rows"][method] = compare_strands(
            read_strands(out / method / "strands.npz"),
            truth,
            cameras=capture.rig.cameras,
            head=capture.head,
            samples=samples,
        )
    _save(out / "imported.json", results)
    return results


def baselines(
    capture: Capture, model: Path, spacing: float, ball: tuple[ArrayLike, float]
) -> dict[str, Strands]:
    """The baselines that use no method, in the masks that the reconstruction had.

    Only in the `ball`, its centre and radius: cameras that see a patch bound no hull elsewhere.
    """
    masks: dict[str, Bools] = {}
    for camera in capture.rig.cameras:
        file = model / "masks" / f"{camera.name}_hair.png"
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise FileNotFoundError(f"{file}: no mask that the reconstruction had")
        masks[camera.name] = np.asarray(image > 127)
    hull = within_ball(
        baseline_hull(capture.rig.cameras, masks, capture.head, spacing=spacing), *ball
    )
    return {
        "hull_vertical": hull_vertical(hull),
        "hull_smooth_field": hull_smooth_field(hull, capture.head),
    }


def within_ball(hull: VoxelGrid, center: ArrayLike, radius: float) -> VoxelGrid:
    """The voxels whose centres lie in a ball, on a grid no larger than it."""
    c = np.asarray(center, float)
    low, high = hull.index(np.stack([c - radius, c + radius]))
    low, high = np.maximum(low, 0), np.minimum(high + 1, hull.inside.shape)
    part = hull.inside[tuple(slice(a, max(a, b)) for a, b in zip(low, high, strict=True))]
    out = VoxelGrid(hull.origin + low * hull.spacing, hull.spacing, part.copy())
    out.inside[out.inside] = np.linalg.norm(out.centers() - c, axis=1) <= radius
    return out


def quick(options: ReconstructOptions) -> ReconstructOptions:
    """Without the parts of a report that cost time and tell nothing here."""
    return replace(options, explicit_seconds=0.0)


def _stages(report: Report) -> dict[str, float]:
    return {s.name: s.seconds for s in report.stages}


def _save(path: Path, results: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(json.dumps(results, indent=1, allow_nan=False) + "\n")
    part.replace(path)


def thresholds_met(row: dict[str, Any], sun: AnyFloats) -> dict[str, list[bool]]:
    """For visible and all, at which thresholds F is above Sun's `(3,)` per cent."""
    return {
        over: [100 * s["f"] > f for s, f in zip(row[over].values(), sun, strict=True)]
        for over in ("visible", "all")
    }
