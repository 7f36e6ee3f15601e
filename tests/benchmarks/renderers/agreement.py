"""A capture that Blender Cycles rendered, rendered again from its true strands."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from appearance import Exposure, HairScene, render_olat
from appearance.metrics.pictures import Row, comparison_picture
from benchmarks.command import CAPTURE, Benchmark, cycles_folder
from benchmarks.renderers.path_reference import PathReference
from benchmarks.results import markdown, save
from benchmarks.subjects import cycles_subject
from reconstruction import Camera, Capture, Light, Progress, import_folder, silent
from reconstruction.arrays import Array, Floats, Ints

CYCLES, OURS, STOCK = "Cycles", "ours", "Mitsuba"
PAIRS = ((OURS, CYCLES), (STOCK, CYCLES), (OURS, STOCK))
_TILE = 8
_RESAMPLES = 400


def agreement(
    out: Path,
    folder: Path,
    *,
    cameras: Sequence[int] = (0, 3, 6),
    lights: Sequence[int] = (0, 3, 6, 9),
    seeds: int = 4,
    spp: int = 32,
    seed: int = 0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Compare radiance on the hair; write `agreement.json`, `.md` and `.png`.

    `folder` is what `import_folder` reads, with the true strands and the elliptic head
    (`strands_gt.npz`) and their materials (`params.json`). Its `cameras` are rendered under its
    `lights` (indices) in `seeds` independent runs of `spp` paths a pixel: by `render_olat` with
    `extended_hair` ("ours"), and by Mitsuba's `path` with Mitsuba's `hair`.

    For each of `PAIRS` and each channel: `ratio` of the mean radiance over all hair pixels of all
    pictures, and `correlation` of the means of tiles of 8 × 8 pixels in one picture, averaged over
    the pictures. `…_seeds` are standard errors from the scatter of the runs, `…_tiles` from
    drawing the tiles anew with replacement, which also counts what the other side's noise and
    local disagreement do. `pictures` holds the ratio in the picture where it is least and in
    that where it is greatest. Returns what `agreement.json` holds; raises `ImportProblem` or
    `OSError` naming what is missing in `folder`, and `ValueError` for fewer than two seeds.
    """
    if seeds < 2:
        raise ValueError(f"a standard error needs at least two seeds, got {seeds}")
    subject, params = cycles_subject(folder)
    scene = subject.scene()
    # a camera's own segment of the path is one of Mitsuba's depth, but no vertex
    depth = int(params["equivalent_mitsuba"]["max_depth"]) - 1
    with tempfile.TemporaryDirectory() as scratch:
        progress("reading the capture", 0.0)
        capture = import_folder(folder, Path(scratch) / "capture")
        lamps = [capture.rig.lights[i] for i in lights]
        views: list[Renderings] = []
        for i in cameras:
            progress("rendering", len(views) / len(cameras))
            views.append(_view(capture, scene, capture.rig.cameras[i], lamps, depth, (seeds, spp)))
    result: dict[str, Any] = {
        "cameras": [v.camera.name for v in views],
        "lights": [x.name for x in lamps],
        "hair_pixels": sum(len(v.pixels) for v in views),
        "spp": spp,
        "seeds": seeds,
        "max_depth": depth,
        "pairs": {f"{a} / {b}": compare(views, a, b, seed) for a, b in PAIRS},
    }
    save(out / "agreement.json", result)
    (out / "agreement.md").write_text(table(result))
    _picture(out / "agreement.png", views)
    return result


@dataclass(frozen=True)
class Renderings:
    """A camera's hair pixels `(P,)` in all renderings of it.

    `radiance[name]` is `(K, L, P, 3)`: K independent runs, one for Cycles; `tile (P,)` numbers the
    tiles of the image from 0, without gaps.
    """

    camera: Camera
    lights: Sequence[Light]
    pixels: Ints
    radiance: Mapping[str, Floats]

    @property
    def tile(self) -> Ints:
        """Index of each pixel's tile."""
        row, column = np.divmod(self.pixels, self.camera.width)
        tiles = (row // _TILE) * self.camera.width + column // _TILE
        return np.unique(tiles, return_inverse=True)[1]


@dataclass(frozen=True)
class _Tiles:
    """Sums over tiles: pixels `(B,)`, radiance of two renderings `(L, B, 3)`."""

    count: Array
    one: Array
    other: Array


def _view(
    capture: Capture,
    scene: HairScene,
    camera: Camera,
    lights: Sequence[Light],
    depth: int,
    samples: tuple[int, int],
) -> Renderings:
    mask = capture.mask(camera.name)
    if mask is None or not mask.any():
        raise ValueError(f"{capture.path}: no hair mask of {camera.name}: nothing to compare")
    pixels = np.flatnonzero(mask)
    truth, _ = capture.olat(camera.name, [x.name for x in lights])
    path = PathReference(scene.with_hair(scene.hair, bsdf="hair"), depth)
    seeds, spp = samples

    def runs(render: Callable[[int], Floats]) -> Floats:
        return np.stack([render(k) for k in range(seeds)])

    return Renderings(
        camera,
        lights,
        pixels,
        {
            CYCLES: truth.reshape(1, len(lights), -1, 3)[:, :, pixels],
            OURS: runs(
                lambda k: render_olat(
                    scene, camera, lights, spp=spp, max_depth=depth, seed=k, pixels=pixels
                )
            ),
            STOCK: runs(lambda k: path.render(camera, lights, pixels, spp=spp, seed=seeds + k)),
        },
    )


def compare(views: Sequence[Renderings], one: str, other: str, seed: int = 0) -> dict[str, Any]:
    """The figures of a pair, see `agreement`; lists are by channel."""
    whole = [_tiles(v, v.radiance[one].mean(0), v.radiance[other].mean(0)) for v in views]
    runs = max(len(views[0].radiance[name]) for name in (one, other))
    single = [
        [_tiles(v, *(v.radiance[n][k % len(v.radiance[n])] for n in (one, other))) for v in views]
        for k in range(runs)
    ]
    rng = np.random.default_rng(seed)
    once = [np.ones(len(t.count)) for t in whole]
    drawn = [
        [rng.multinomial(len(w), w / len(w)).astype(float) for w in once] for _ in range(_RESAMPLES)
    ]
    figures: dict[str, Any] = {}
    for name, statistic in (("ratio", _ratio), ("correlation", _correlation)):
        scatter = np.array([statistic(tiles, once) for tiles in single])
        anew = np.array([statistic(whole, weights) for weights in drawn])
        figures[name] = statistic(whole, once).tolist()
        figures[f"{name}_seeds"] = (scatter.std(0, ddof=1) / np.sqrt(runs)).tolist()
        figures[f"{name}_tiles"] = anew.std(0, ddof=1).tolist()
    by_picture = np.concatenate([t.one.sum(1) / t.other.sum(1) for t in whole])
    figures["pictures"] = [by_picture.min(0).tolist(), by_picture.max(0).tolist()]
    return figures


def _tiles(view: Renderings, one: Floats, other: Floats) -> _Tiles:
    tile = view.tile
    count = np.bincount(tile).astype(float)

    def sums(radiance: Floats) -> Array:
        out = np.zeros((len(count), len(radiance), 3))
        np.add.at(out, tile, radiance.transpose(1, 0, 2))
        return out.transpose(1, 0, 2)

    return _Tiles(count, sums(one), sums(other))


def _ratio(tiles: Sequence[_Tiles], times: Sequence[Array]) -> Array:
    """Ratio of the means `(3,)`, each tile counted `times (B,)`."""
    one, other = (
        sum(np.einsum("b,lbc->c", w, x) for w, x in zip(times, sums, strict=True))
        for sums in ([t.one for t in tiles], [t.other for t in tiles])
    )
    return np.asarray(one / other)


def _correlation(tiles: Sequence[_Tiles], times: Sequence[Array]) -> Array:
    """Pearson's correlation `(3,)` of tile means, weighted by their pixels, mean over pictures."""
    found = []
    for t, w in zip(tiles, times, strict=True):
        weight = (w * t.count / (w @ t.count))[:, None]
        a, b = (x / t.count[:, None] for x in (t.one, t.other))
        a, b = (x - (weight * x).sum(1, keepdims=True) for x in (a, b))
        spread = (weight * a**2).sum(1) * (weight * b**2).sum(1)
        found.append((weight * a * b).sum(1) / np.sqrt(spread))
    return np.concatenate(found).mean(0)


def table(result: Mapping[str, Any]) -> str:
    """The figures of `agreement` as a table in Markdown; ± from runs, ± from tiles."""
    head = ["", "channel", "mean radiance, ratio", "in single pictures", "correlation of tiles"]
    rows = []
    for pair, figures in result["pairs"].items():
        low, high = figures["pictures"]
        for c, channel in enumerate("RGB"):
            ratio, correlation = (
                f"{figures[n][c]:.4f} ± {figures[n + '_seeds'][c]:.4f} "
                f"± {figures[n + '_tiles'][c]:.4f}"
                for n in ("ratio", "correlation")
            )
            rows.append((pair, channel, ratio, f"{low[c]:.3f} to {high[c]:.3f}", correlation))
    return markdown(head, rows)


def _picture(path: Path, views: Sequence[Renderings]) -> None:
    """A picture of each camera, each under another light, cut to the hair."""
    rows: list[Row] = []
    for i, v in enumerate(views):
        light = (i + 1) % len(v.lights)
        exposure = Exposure.of([v.radiance[CYCLES][:, light]])
        row, column = np.divmod(v.pixels, v.camera.width)
        cut = slice(row.min(), row.max() + 1), slice(column.min(), column.max() + 1)
        shown = {}
        for name, radiance in v.radiance.items():
            image = np.zeros((v.camera.height, v.camera.width, 3))
            image[row, column] = exposure(radiance[:, light].mean(0))
            shown[name] = image[cut]
        rows.append((f"{v.camera.name}, {v.lights[light].name}", shown, {}))
    comparison_picture(path, rows, [CYCLES, OURS, STOCK], height=1.4)


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    folder = cycles_folder(args.capture)
    if not args.quick:
        return agreement(args.out, folder, seed=args.seed, progress=progress)
    return agreement(
        args.out,
        folder,
        cameras=(4,),
        lights=(6, 9),
        seeds=2,
        spp=8,
        seed=args.seed,
        progress=progress,
    )


BENCHMARK = Benchmark(_bench, (CAPTURE,))
