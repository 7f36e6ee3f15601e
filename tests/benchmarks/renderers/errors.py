"""Our renderers beside Mitsuba's own path integrator.

Error against run time light by light. Leaves `renderers.json` and `renderers.png`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from appearance import render_olat
from appearance.render.bounces import bounce_limit
from benchmarks.command import SUBJECT, Benchmark
from benchmarks.renderers.cost import Effort, View
from benchmarks.renderers.path_reference import PathReference
from benchmarks.results import Panel, draw_panels, save
from benchmarks.subjects import Subject, simulated
from reconstruction import Camera, Light, Progress, Rig, silent
from reconstruction.arrays import Floats
from reconstruction.geometry.lights import dome_positions

_JUDGED = 12  # lights whose error is measured
_STYLES = {"mitsuba path": "k.-", "ours": "C0o-"}
QUICK = Effort((3,), 60, (2, 8), (2, 4), 128)


def run(
    out: Path,
    subjects: Mapping[str, Subject],
    camera: Camera,
    *,
    effort: Effort | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Measure all; write the results into `out` and return what its JSON file holds.

    The error is the mean squared error over the mean square of the reference, averaged over the
    same 12 random lights of the dome for every method. The reference is Mitsuba's `path` light by
    light; its two halves are independent, so that its own variance can be taken off. Methods take
    turns in one process, and kernels are compiled before a clock starts; what tracing them again
    takes (some 0.1 s each, three for `render_olat`) counts. Times are of all lights;
    `path` renders the judged ones and its time is scaled to all, as it does them one by one.
    """
    effort = Effort() if effort is None else effort
    result: dict[str, Any] = {"camera": [camera.width, camera.height], "subjects": {}}
    for k, (name, subject) in enumerate(subjects.items()):
        progress(name, k / len(subjects))
        view = View.of(subject, camera, effort.pixels, seed)
        result["subjects"][name] = {
            **_Errors(view, effort).measured(),
            "strands": len(subject.strands),
        }
        save(out / "renderers.json", result)
    draw_panels(out / "renderers.png", _panels(result))
    return result


def dome(count: int, seed: int) -> list[Light]:
    """`count` of the 331 lights of a dome of 1.2 m; fewer are a part of more, in random order."""
    places = dome_positions(331, 1.2, -50.0)
    order = np.random.default_rng(seed).permutation(len(places))[:count]
    return [Light(f"lamp_{i:03d}", places[i], np.full(3, 8.0)) for i in order]


class _Errors:
    """Error against time of one subject."""

    def __init__(self, view: View, effort: Effort) -> None:
        self.view, self.effort = view, effort
        self.limit = bounce_limit(view.scene, view.camera, pixels=view.index, seed=view.seed)
        self.path = PathReference(view.scene, self.limit.depth)
        self.judged = dome(_JUDGED, view.seed)
        self._path(self.judged[:1], 1, view.seed)
        half = effort.reference_spp // 2
        self.halves = [self._path(self.judged, half, view.seed + k) for k in (1, 2)]

    def measured(self) -> dict[str, Any]:
        """The curves under each number of lights, and how far our mean is from `path`'s."""
        limit = self.limit
        return {
            "pixels": len(self.view.index),
            "bounces": {"limit": limit.depth, "left_out": limit.left_out, "bound": limit.bound},
            "reference_spp": self.effort.reference_spp,
            "agreement": self._agreement(),
            "lights": {str(count): self._curves(count) for count in self.effort.lights},
        }

    def _path(self, lights: list[Light], spp: int, seed: int) -> Floats:
        return self.path.render(self.view.camera, lights, self.view.index, spp=spp, seed=seed)

    def _ours(self, lights: list[Light], spp: int, seed: int) -> Floats:
        view = self.view
        return render_olat(
            view.scene,
            view.camera,
            lights,
            spp=spp,
            seed=seed,
            pixels=view.index,
            max_depth=self.limit.depth,
        )

    def _curves(self, count: int) -> dict[str, Any]:
        lights, judged_count, effort = dome(count, self.view.seed), min(count, _JUDGED), self.effort
        methods: dict[str, Callable[[int, int], Floats]] = {
            "ours": lambda spp, seed: self._ours(lights, spp, seed),
            "mitsuba path": lambda spp, seed: self._path(self.judged[:judged_count], spp, seed),
        }
        for method in [*methods.values()] * 2:  # a second call may compile a second variant
            method(min(effort.spp), self.view.seed)
        series = []
        for turn in range(max(len(effort.spp), len(effort.path_spp))):
            for name, method in methods.items():
                counts = effort.path_spp if name == "mitsuba path" else effort.spp
                if turn < len(counts):
                    wall, cpu = time.perf_counter(), time.process_time()
                    image = method(counts[turn], self.view.seed + 10 + turn)
                    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
                    scale = count / judged_count if name == "mitsuba path" else 1.0
                    series.append(
                        {
                            "method": name,
                            "spp": counts[turn],
                            "seconds": wall * scale,
                            "cpu_seconds": cpu * scale,
                            "rel_mse": relative_mse(
                                image[:judged_count], *(h[:judged_count] for h in self.halves)
                            ),
                        }
                    )
        return {"series": series, "gain": _gains(series)}

    def _agreement(self) -> dict[str, float]:
        """Mean radiance over lights and pixels, ours / `path`, and the ratio's standard error."""
        half, seed = self.effort.reference_spp // 2, self.view.seed
        ours = [self._ours(self.judged, half, seed + k) for k in (3, 4)]
        mine, theirs = (np.mean(pair, (0, 2, 3), float) for pair in (ours, self.halves))  # by light
        ratio = mine.sum() / theirs.sum()
        error = (mine - ratio * theirs).std(ddof=1) / theirs.mean() / np.sqrt(len(mine))
        return {"ratio": float(ratio), "standard_error": float(error)}


def relative_mse(image: Floats, first: Floats, second: Floats) -> float:
    """Relative mean squared error of `image (L, P, 3)`, without the reference's own variance.

    The reference is the mean of two independent unbiased renders `first` and `second`; a quarter
    of their mean squared difference is its variance. Lights weigh alike; lights that reach
    nothing are left out.
    """
    axes = (1, 2)
    a, b = first.astype(float), second.astype(float)
    noise = ((a - b) ** 2).mean(axes) / 4
    power = ((a + b) ** 2).mean(axes) / 4 - noise
    error = ((image - (a + b) / 2) ** 2).mean(axes) - noise
    reached = power > 0
    if not reached.any():
        raise ValueError("no light reaches the subject: there is no error to speak of")
    return float((error[reached] / power[reached]).mean())


def _gains(series: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """How many times longer `path` takes to the error of each of our points.

    `path` is unbiased: error x time is one number, averaged over its points.
    """
    gains: dict[str, dict[str, float]] = {}
    for clock in ("seconds", "cpu_seconds"):
        theirs = np.mean([p["rel_mse"] * p[clock] for p in series if p["method"] == "mitsuba path"])
        for p in series:
            if p["method"] != "mitsuba path":
                gain = float(theirs / (p["rel_mse"] * p[clock]))
                gains.setdefault(f"{p['method']}, {clock}", {})[str(p["spp"])] = gain
    return gains


def _panels(result: dict[str, Any]) -> list[list[Panel]]:
    """A row for each subject, a column for each number of lights."""

    def panel(name: str, count: str, series: list[dict[str, Any]]) -> Panel:
        curves = {
            method: [(p["cpu_seconds"], p["rel_mse"]) for p in series if p["method"] == method]
            for method in _STYLES
        }
        return Panel(f"{name}, {count} lights", curves, styles=_STYLES)

    return [
        [panel(name, count, entry["series"]) for count, entry in subject["lights"].items()]
        for name, subject in result["subjects"].items()
    ]


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    camera = Rig.load(args.rig).cameras[0]
    fov_deg = float(np.degrees(2 * np.arctan(camera.width / 2 / camera.K[0, 0])))
    ahead = camera.center + camera.R[2]
    small = Camera.look_at(camera.name, 128, 128, camera.center, ahead, fov_deg)
    progress("making the subjects", 0.0)
    subjects = {
        Path(args.subject).stem: simulated(args.rig, args.subject, args.head, args.seed),
    }
    # eumelanin of pbrt's table: 0.3 and 8
    for name, groom, sigma_a in (
        ("straight blond", "straight", (0.126, 0.209, 0.411)),
        ("black curls", "curly", (3.35, 5.58, 10.96)),
    ):
        if not args.quick:
            made = simulated(args.rig, groom, None, args.seed)
            subjects[name] = replace(made, hair=replace(made.hair, sigma_a=sigma_a))
    effort = QUICK if args.quick else None
    return run(args.out, subjects, small, effort=effort, seed=args.seed, progress=progress)


BENCHMARK = Benchmark(_bench, SUBJECT)
