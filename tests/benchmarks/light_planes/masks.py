"""Automatic hair masks beside the true ones, at several path counts: noise must not decide them.

And what the demo's job makes of the captures by its own masks and by the true ones; and strands,
and a head, of the same captures without their sweep and head, as of photographs under single
lights, by masks that light alone has told. Captures of the demo's rig go through the wires once and
are kept. Leaves `masks.json` and `masks.md`.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from appearance import HairAppearance, build_scene
from appearance.render.coverage import coverage
from benchmarks.captures import SimulatedCapture
from benchmarks.command import CACHE, ONLY, Benchmark, LeftOut, data_folder, option, within
from benchmarks.demo import markdown_table
from benchmarks.light_planes.subjects import FRAMINGS, subject_capture
from benchmarks.light_planes.without_help import copied
from benchmarks.results import save
from benchmarks.strand_truth import StrandTruth
from reconstruction import Capture, Mesh, Model, Progress, Stage, read_strands, reconstruct
from reconstruction.geometry.mesh_queries import surface_samples
from reconstruction.growth.hair_envelope import build_envelope
from reconstruction.light_planes import triangulate
from reconstruction.mask_geometry import distance_to
from reconstruction.masks import (
    HairMask,
    MaskedCapture,
    disagreements,
    hair_masks,
)
from stage_service.cli.demo import hold_out
from stage_service.cli.support.commands import rig_path, whole
from stage_service.jobs.records import JobOptions
from stage_service.jobs.steps import STEPS, StepContext
from stage_service.model_page.names import THRESHOLDS, threshold

SUBJECTS = ("wavy", "curly", "sintel", "dressed")
JOB = ("reconstruct", "fit", "assess", "evaluate", "results")
"""Of the pipeline "full", what masks can change: inverse rendering is taken on no demo."""

QUICK = {
    "fit": {"roughness_spp": 2, "colour_spp": 2, "iterations": 1},
    "assess": {"cameras": 1, "lights": 1, "spp": 2, "relit_size": 16, "relit_spp": 1},
}
LEAST_SHARE = 0.1
"""Of a pixel that the subject must cover to be in its true mask: less is near a frame's noise."""

DRAWS = option(
    "--draws",
    "seeds of the reconstruction, for F's spread",
    type=int,
    choices=range(1, 9),
    default=1,
)
LIGHTS = option("--lights", "of the dome, 24 at least", type=whole(24, 331), default=331)
PATHS = option("--paths", "paths a pixel of the frames", type=int, nargs="+", default=[16, 64])


def true_masks(capture: Capture, folder: Path) -> dict[str, HairMask]:
    """What each pixel shows most of, hair or not, by rendering the truth in `folder`."""
    hair = HairAppearance.from_dict(json.loads((folder / "appearance.json").read_text())["hair"])
    surface = capture.head
    if (worn := folder / "dressed.npz").is_file():
        with np.load(worn) as dressed:
            surface = Mesh(dressed["vertices"], dressed["faces"])
    scene = build_scene(read_strands(folder / "strands.npz"), surface, hair=hair)
    out = {}
    for camera in capture.rig.cameras:
        share = coverage(scene, camera, 64)
        subject = share["hair"] + share["head"] > LEAST_SHARE
        hairy = subject & (share["hair"] >= share["head"])
        out[camera.name] = HairMask(subject, hairy, subject & ~hairy, "user", 1.0)
    return out


def overlaps(masks: Mapping[str, HairMask], true: Mapping[str, HairMask]) -> dict[str, float]:
    """Intersection over union of hair, by camera."""
    out = {}
    for name, mask in true.items():
        found, both = masks[name].hair, masks[name].hair & mask.hair
        out[name] = float(both.sum() / max((found | mask.hair).sum(), 1))
    return out


class SingleLights(Capture):
    """A capture as if neither a sweep was shot nor the head digitised."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.steps = tuple(s for s in self.steps if s.kind != "scanline")

    @property
    def head(self) -> None:
        """None."""


def demo_job(
    capture: Capture,
    truth: Path,
    model: Model,
    options: JobOptions,
    progress: Progress,
    steps: Sequence[str] = JOB,
) -> dict[str, Any]:
    """What the steps of the demo's job on `capture` tell, by their names."""
    requested = options.model_copy(update={"truth": str(truth), **hold_out(capture.rig)})
    done: dict[str, Any] = {}
    for k, name in enumerate(steps):
        report_progress = within(progress, name, k / len(steps), 1 / len(steps))
        begin = time.perf_counter()
        figures = STEPS[name](StepContext(capture.path, model, requested, report_progress, done))
        done[name] = {"figures": figures, "seconds": time.perf_counter() - begin}
    return {name: of_step["figures"] for name, of_step in done.items()}


def judge(
    folder: Path,
    truth_folder: Path,
    out: Path,
    options: JobOptions,
    draws: int,
    progress: Progress,
) -> dict[str, Any]:
    """Overlaps, disagreements and the envelope, with masks of the light, without head and true.

    Then the demo's job by its own masks and by the true ones, strands by its own masks with `draws`
    seeds in all, and strands of single lights alone, whose baselines have the head. Models are left
    in `out`.
    """
    capture = Capture(folder)
    cloud, head = triangulate(capture), capture.head
    assert head is not None
    true = true_masks(capture, truth_folder)
    reported: dict[str, Any] = {}
    kinds = {
        "automatic": hair_masks(capture, cloud, head),
        "without head": hair_masks(capture, cloud),
        "true": true,
    }
    for kind, masks in kinds.items():
        stage = Stage("envelope")
        masked = MaskedCapture(capture, masks)
        build_envelope(masked, cloud, head, grid=2e-3, margin=2e-3, stage=stage)
        reported[kind] = {
            "overlap": overlaps(masks, true),
            "disagreement": disagreements(masks, capture.rig.cameras, cloud, head),
            "envelope_litres": stage.figures["envelope_litres"],
        }
    given = copied(capture, out / "capture")
    for name, mask in true.items():
        (given.path / "masks").mkdir(exist_ok=True)
        cv2.imwrite(str(given.path / "masks" / f"{name}.png"), 255 * mask.hair.astype(np.uint8))
    reported["jobs"], reported["drawn_again"], share = {}, [], 1 / (1 + draws)
    for k, (kind, shot) in enumerate({"automatic": capture, "true": given}.items()):
        model, report_progress = (
            Model(out / kind),
            within(progress, f"{kind} masks", k * share, share),
        )
        demo_job(shot, truth_folder, model, options, report_progress)
        reported["jobs"][kind] = model.json("results.json")
    for k in range(1, draws):
        model, report_progress = (
            Model(out / f"draw_{k}"),
            within(progress, f"draw {k}", (1 + k) * share, share),
        )
        again = options.model_copy(update={"seed": options.seed + k})
        found = demo_job(
            capture, truth_folder, model, again, report_progress, ("reconstruct", "evaluate")
        )
        reported["drawn_again"].append(
            {over: found["evaluate"][over] for over in ("visible", "all")}
        )
    alone, model = SingleLights(folder), Model(out / "single_lights_alone")
    reconstruct(alone, model, method="auto")
    truth = StrandTruth(capture, truth_folder)
    reported["single lights alone"] = {
        "overlap": overlaps(hair_masks(alone), true),
        "head_mm": _apart(model.head(alone), head),
        "strands": {"ours": truth.score(model.strands()), **truth.baselines(model)},
    }
    return reported


def _apart(found: Mesh | None, true: Mesh) -> dict[str, float] | None:
    """Millimetres from the upper 22 cm of the head that was found to the true one."""
    if found is None:
        return None
    points = surface_samples(found, 4e-3)[0]
    upper = points[points[:, 2] > true.vertices[:, 2].max() - 0.22]
    apart = 1e3 * np.abs(distance_to(true, upper))
    return {f"p{q}": float(np.percentile(apart, q)) for q in (50, 95)}


def _captures(args: argparse.Namespace) -> dict[tuple[str, int], SimulatedCapture]:
    """By subject and paths."""
    if args.quick:
        framing = replace(FRAMINGS["curly"], rows=21, coarser=6)
        return {("curly", 16): subject_capture("curly", framing, args.cache, 0.0)}
    rig, data = rig_path("demo").read_text(), data_folder()
    for old, new in (
        ("lights = 331", f"lights = {args.lights}"),
        ("busy_s = 3600.0", "busy_s = 86400.0"),  # frames of 256 paths take hours
    ):
        assert rig.count(old) == 1, f"the demo's rig has no {old!r}"
        rig = rig.replace(old, new)
    names = [n for n in SUBJECTS if args.only in (None, n) and (n != "sintel" or data)]
    if not names:
        raise LeftOut(f"no subject {args.only!r}; there are {', '.join(SUBJECTS)}")
    out = {}
    for name in names:
        subject, head = name, None
        if name == "sintel" and data:
            subject, head = (str(data / name / f) for f in ("sintel.npz", "sintel_head.obj"))
        for paths in args.paths:
            label = f"masks-{name}-{paths}-of-{args.lights}"
            out[name, paths] = SimulatedCapture(
                label, rig, subject, head, spp=paths, seed=args.seed
            )
    return out


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Each subject at each number of paths; see `judge`."""
    results: dict[str, Any] = {}
    captures = _captures(args)
    for k, ((name, paths), capture) in enumerate(captures.items()):
        report_progress = within(
            progress, f"{name}, {paths} paths", k / len(captures), 1 / len(captures)
        )
        folder, truth = capture.make(args.cache, within(report_progress, "capture", 0.0, 0.7))
        options = JobOptions.model_validate(QUICK if args.quick else {})
        options = options.model_copy(update={"seed": args.seed})
        into = args.out / f"masks-{name}-{paths}"
        judged = judge(
            folder, truth, into, options, args.draws, within(report_progress, "judged", 0.7, 0.3)
        )
        results.setdefault(name, {})[str(paths)] = judged
        save(args.out / "masks.json", results)
        (args.out / "masks.md").write_text(report(results, args.seed))
    return results


def report(results: Mapping[str, Mapping[str, Any]], seed: int) -> str:
    """The overlaps, and the README's table of the jobs."""
    jobs, text = {}, []
    for name, of_paths in results.items():
        for paths, judged in of_paths.items():
            reported = judged["automatic"]["overlap"].values()
            text.append(f"- {name}, {paths} paths: masks overlap by {min(reported):.3f} at least")
            again = [f["visible"] for f in judged["drawn_again"]]
            drawn = [judged["jobs"]["automatic"]["geometry"]["visible"], *again]
            for at in THRESHOLDS:
                f = [100 * one[at]["f"] for one in drawn]
                text.append(
                    f"  - F {threshold(at)} of visible points: {np.mean(f):.1f}"
                    + (f" ± {np.std(f, ddof=1):.1f} over {len(f)} seeds" if len(f) > 1 else "")
                )
            for kind, job in judged["jobs"].items():
                jobs[f"{name}, {paths} paths, {kind} masks"] = [{**job, "seed": seed}]
    return "\n".join([*text, "", markdown_table(jobs), ""])


BENCHMARK = Benchmark(run, (CACHE, ONLY, PATHS, LIGHTS, DRAWS))
