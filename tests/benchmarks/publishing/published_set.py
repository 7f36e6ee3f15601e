"""A set for comparing methods of reconstruction: captures of procedural subjects, true strands.

Written as EXR, COLMAP text and JSON with a scorer that needs NumPy and SciPy only; then read back
by `hairstage import`, reconstructed, scored by that scorer beside baselines, and compared with
`hairstage evaluate`. Leaves the set and `publish-set.json`.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.captures import Optics, SimulatedCapture, levels, rig_file
from benchmarks.command import CACHE, ONLY, Benchmark, LeftOut, Option, option, within
from benchmarks.importing.damages import run_product
from benchmarks.importing.folders import write_colmap
from benchmarks.results import save
from benchmarks.strand_truth import write_hair_masks
from reconstruction import (
    Capture,
    Mesh,
    Progress,
    Strands,
    read_obj,
    read_strands,
    write_exr,
    write_strands,
)
from reconstruction.evaluation.baselines import baseline_hull, hull_smooth_field, hull_vertical
from reconstruction.evaluation.visibility import Visibility
from reconstruction.files.durable import write_json
from reconstruction.geometry.lights import dome_positions
from reconstruction.images.silhouettes import lit_rgb
from reconstruction.images.srgb import srgb
from stage_service.cli.support.commands import CommandError

HERE = Path(__file__).resolve().parent
SCORER = HERE.parents[2] / "examples" / "score_alone.py"
SUBJECTS = ("wavy", "straight", "curly")
TARGET = (0.0, 0.0, -0.03)
WIDTH_M, DISTANCE = 0.42, 0.95
THRESHOLDS = ("1mm_10deg", "2mm_20deg", "3mm_30deg")


def rig_text(cameras: int, lights: int, side: int, rows: int) -> str:
    """A rig file: cameras on a sphere that see the whole hair; with `rows`, two projectors."""
    optics = Optics(TARGET, math.degrees(2 * math.atan(WIDTH_M / 2 / DISTANCE)))
    devices = [
        optics.device("cameras", k, [p + t for p, t in zip(place, TARGET, strict=True)])
        + f"width = {side}\nheight = {side}"
        for k, place in enumerate(dome_positions(cameras, DISTANCE, 0.0).tolist())
    ]
    wide = Optics(TARGET, 20.0)
    devices += [
        wide.device("projectors", k, place) + f"roll_deg = 90.0\nwidth = {rows}\nheight = {rows}\n"
        "intensity = [20.0, 20.0, 20.0]\nline_sigma = 0.6"
        for k, place in enumerate(([0.0, 1.06, 0.28], [0.0, -1.06, 0.28]))
        if rows
    ]
    dome = f"lights = {lights}\nradius = 1.2\nlowest_deg = -30.0"
    return rig_file("published", dome, devices, levels(all_on=min(1.0, 3 / lights)))


def write_subject(capture: Capture, truth: Path, folder: Path) -> None:
    """Write `capture` and its `truth` as `stage/`, `lit/` and `truth/` of the new `folder`."""
    for name in ("strands.npz", "head.obj", "appearance.json"):
        (folder / "truth").mkdir(parents=True, exist_ok=True)
        shutil.copyfile(truth / name, folder / "truth" / name)
    true, head = published_truth(folder)
    write_hair_masks(capture, folder / "truth")
    _write_stage(capture, folder / "stage")
    _write_lit(capture, folder / "lit")
    for variant in (folder / "stage", folder / "lit"):
        _write_cameras(capture, variant, "{}/all.exr" if variant.name == "stage" else "{}.png")
        shutil.copyfile(truth / "head.obj", variant / "head.obj")
        shutil.copytree(capture.path / "masks", variant / "masks")
    (folder / "truth" / "visibility").mkdir()
    found: Any
    for name, found in Visibility(capture.rig.cameras, true, head).depth_maps().items():
        np.savez_compressed(folder / "truth" / "visibility" / f"{name}.npz", **found)


def published_truth(folder: Path) -> tuple[Strands, Mesh]:
    """True strands and head of a published subject."""
    return read_strands(folder / "truth" / "strands.npz"), read_obj(folder / "truth" / "head.obj")


def _write_stage(capture: Capture, folder: Path) -> None:
    """Frames of the capture at full level, lights, projectors, and import.toml."""
    names = {
        "olat": "images/{camera}/{light}.exr",
        "all_on": "all_on/{camera}.exr",
        "dark": "dark/{camera}.exr",
        "scanline": "scanline/{camera}/{projector}_{row}.exr",
    }
    steps = [s for s in capture.steps if s.kind in names]
    for step in steps:
        for camera in capture.rig.cameras:
            if not capture.has(step, camera.name):
                continue
            fields = {"camera": camera.name, "light": step.light, "projector": step.projector}
            path = folder / names[step.kind].format(row=step.row, **fields)
            path.parent.mkdir(parents=True, exist_ok=True)
            if step.kind == "dark":
                write_exr(path, capture.frame(step, camera.name))
                continue
            image, saturated = capture.response_and_saturated(step, camera.name)
            full = image[saturated].max(axis=-1).min(initial=np.inf)
            write_exr(path, image, {"fullScale": float(full)} if saturated.any() else {})
    used = {s.kind for s in steps}
    patterns = "".join(f'{kind} = "{names[kind]}"\n' for kind in names if kind in used)
    (folder / "import.toml").write_text(
        f'units = "radiance"\n[sensor]\nresponse = "linear"\n[pictures]\n{patterns}'
    )
    lights = [
        {"id": x.name, "position": x.position.tolist(), "intensity": x.intensity.tolist()}
        for x in capture.rig.lights
    ]
    write_json(folder / "lights.json", {"lights": lights})
    if "scanline" in used:
        projectors = capture.rig.to_dict()["projectors"]
        write_json(folder / "projectors.json", {"projectors": projectors})


def _write_lit(capture: Capture, folder: Path) -> None:
    """One photograph a camera, all at one exposure: 99 % of the hair is below white."""
    images = {c.name: lit_rgb(capture, c.name) for c in capture.rig.cameras}
    hair = [i[capture.mask(n)].max(axis=-1) for n, i in images.items()]
    white = np.quantile(np.concatenate(hair), 0.99)
    (folder / "images").mkdir(parents=True)
    (folder / "linear").mkdir()
    for name, image in images.items():
        write_exr(folder / "linear" / f"{name}.exr", image)
        shot = np.round(255 * srgb(np.clip(image / np.float32(white), 0, 1)))
        cv2.imwrite(str(folder / "images" / f"{name}.png"), shot.astype(np.uint8)[..., ::-1])


def _write_cameras(capture: Capture, folder: Path, picture: str) -> None:
    cameras = [
        {"id": c.name, "width": c.width, "height": c.height}
        | {"K": c.K.tolist(), "R": c.R.tolist(), "t": c.t.tolist()}
        for c in capture.rig.cameras
    ]
    write_json(folder / "cameras.json", {"cameras": cameras})
    write_colmap(capture, folder / "sparse" / "0", 1.0, picture)
    (folder / "sparse" / "0" / "points3D.txt").write_text("")


def score_alone(folder: Path, strands: Path, *arguments: object) -> dict[str, Any]:
    """What the set's scorer prints of a strand file, run without the packages of this checkout."""
    truth = folder / "truth"
    command: Sequence[object] = (
        *(sys.executable, "-I", folder.parent / "score.py", strands, truth / "strands.npz"),
        *("--visibility", truth / "visibility", *arguments),
    )
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True)
    if done.returncode:
        raise CommandError(f"score.py: {done.stderr[-600:]}", done.returncode)
    return dict(json.loads(done.stdout))


def baselines(folder: Path) -> dict[str, dict[str, Any]]:
    """Scores of what uses the masks and the head alone."""
    capture, head = Capture(folder / "imported" / "stage"), published_truth(folder)[1]
    masks = {c.name: capture.mask(c.name) for c in capture.rig.cameras}
    hull = baseline_hull(
        capture.rig.cameras, {n: m for n, m in masks.items() if m is not None}, head
    )
    out = {}
    filled = {"vertical": hull_vertical(hull), "smooth_field": hull_smooth_field(hull, head)}
    for name, strands in filled.items():
        with tempfile.TemporaryDirectory() as work:
            write_strands(Path(work) / "strands.npz", strands)
            out[f"hull_{name}"] = score_alone(folder, Path(work) / "strands.npz")
    return out


def read_back(folder: Path, options: dict[str, Any]) -> dict[str, Any]:
    """Rows of a published subject: ours from both variants, baselines, and the agreement.

    `difference` is the largest one of `score.py` from `hairstage evaluate geometry`, over
    precision, recall and F of all, visible and equal length, and strand consistency.
    """
    rows: dict[str, Any] = {}
    for variant in ("stage", "lit"):
        capture, model = folder / "imported" / variant, folder / "models" / variant
        run_product("import", folder / variant, "--out", capture)
        run_product("reconstruct", capture, "--out", model, "--options", json.dumps(options))
        strands = model / "strands.npz"
        ours = score_alone(folder, strands)
        true = folder / "truth" / "strands.npz"
        theirs = run_product("evaluate", "geometry", strands, true, "--capture", capture)
        rows[variant] = {**ours, "difference": difference(ours, theirs)}
    return rows | baselines(folder)


def difference(ours: dict[str, Any], theirs: dict[str, Any]) -> float:
    """The largest difference of `score.py`'s figures from those of `assess_strands`."""
    parts = [(ours[k], theirs[k]) for k in ("visible", "all") if k in ours]
    parts += [(ours["equal_length"][k], theirs["equal_length"][k]) for k in ("visible", "all")]
    found = [
        abs(mine[t][k] - other[t][k])
        for mine, other in parts
        for t in THRESHOLDS
        for k in ("precision", "recall", "f")
    ]
    consistency = theirs["connectivity"]["true"]["strand_consistency"]
    return max(*found, *(abs(ours["strand_consistency"][t] - consistency[t]) for t in THRESHOLDS))


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Write the set, then read it back; see the module's docstring."""
    out = args.folder or args.out / "published"
    if out.exists() and any(out.iterdir()):
        raise LeftOut(f"{out} is not empty: name a new folder")
    names = [n for n in SUBJECTS if args.only in (None, n)][: 1 if args.quick else None]
    if not names:
        raise LeftOut(f"no subject {args.only!r}; there are {', '.join(SUBJECTS)}")
    cameras, lights, side = (4, 6, 64) if args.quick else (args.cameras, args.lights, args.side)
    spp, options = (4, {"grid": 4e-3, "roots": 300}) if args.quick else (args.spp, {})
    rig = rig_text(cameras, lights, side, args.rows)
    commit = subprocess.run(
        ["git", "rev-parse", "--short=12", "HEAD"], cwd=HERE, capture_output=True, text=True
    ).stdout.strip()
    rows: dict[str, Any] = {}
    size = {"cameras": cameras, "lights": lights, "side": side, "rows": args.rows}
    results = {**size, "spp": spp, "subjects": rows}
    for k, name in enumerate(names):
        report = within(progress, name, k / len(names), 1 / len(names))
        shot = SimulatedCapture(f"published-{name}", rig, name, spp=spp, seed=args.seed)
        path, truth = shot.make(args.cache, report)
        write_subject(Capture(path), truth, out / name)
    shutil.copyfile(SCORER, out / "score.py")
    swept = "; each projector row: `scanline/CAMERA/PROJECTOR_ROW.exr`" if args.rows else ""
    said = {"commit": commit, "subjects": ", ".join(names), "spp": spp, "swept": swept}
    (out / "README.md").write_text((HERE / "README.md").read_text().format(**said))
    for name in names:
        progress(f"{name}: read back", 0.9)
        rows[name] = read_back(out / name, options)
        for made in ("imported", "models"):
            shutil.rmtree(out / name / made)
        kept = {k: v for k, v in rows[name].items() if k.startswith("hull")}
        save(out / "baselines" / f"{name}.json", kept)
        save(args.out / "publish-set.json", results)
    return results


BENCHMARK = Benchmark(
    run,
    (
        *(CACHE, ONLY),
        Option("folder", {"help": "of the set, new", "metavar": "SET", "type": Path, "nargs": "?"}),
        *(
            option(f"--{name}", help, type=int, default=value)
            for name, help, value in (
                *(("cameras", "their number", 12), ("lights", "their number", 24)),
                *(("side", "pixels of a picture's edge", 256), ("spp", "paths a pixel", 16)),
                ("rows", "of two projectors; 0: no sweep", 0),
            )
        ),
    ),
)
