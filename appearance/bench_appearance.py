"""Benchmark: the fit's ablations beside baselines, on subjects of known appearance."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appearance.ablation_table import GROUPS, Table, named
from appearance.hair_appearance import HairAppearance
from appearance.hair_maps import HairMaps
from appearance.observations import Observed
from appearance.stage1.loop import Stage1Options, run
from appearance.stage1.problem import Effort, Problem
from appearance.stage1.subjects import SUBJECTS, Captured, Rig, subject
from reconstruction.lights import Light
from reconstruction.mesh import Mesh
from reconstruction.report import Progress, silent
from reconstruction.strands import Strands

Array = NDArray[np.float64]

QUICK = Stage1Options(
    steps=90,
    check_every=30,
    shape=(6, 12, 12),
    effort=Effort(pixels=400, spp=48, gradient_spp=32, max_depth=8),
)
STAGE = Rig(size=36, cameras=5, lights=12, spp=768)
PLAIN_STEPS = 4
"""Of the plain version that are run; the rest of its curve is extrapolated and marked."""


def run_bench(
    out: Path,
    strands: Strands,
    head: Mesh | None,
    hair: HairAppearance,
    skin: Array,
    *,
    names: Sequence[str] = SUBJECTS,
    seeds: int = 1,
    options: Stage1Options = QUICK,
    rig: Rig = STAGE,
    plain: bool = True,
    progress: Progress = silent,
    seed: int = 0,
) -> dict[str, Any]:
    """The table of every subject; recovery on (a); `seeds` and error against run time on (b).

    Writes `appearance.json` and `appearance.md` into `out` and returns the former.
    """
    result: dict[str, Any] = {"options": asdict(options), "rig": asdict(rig), "subjects": {}}
    for name in names:
        captured = subject(name, strands, head, hair, skin, rig, seed)
        table = Table(captured, options, progress=named(progress, name), seed=seed)
        result["subjects"][name] = table.run()
        if name == "a":
            result["recovery"] = recovery(captured, options, named(progress, name), seed)
        if name == "b":
            result["seeds"] = [
                _final(Table(captured, options, seed=seed + k).run()) for k in range(1, seeds)
            ]
            if plain:
                result["time"] = error_against_time(captured, options, progress, seed)
    out.mkdir(parents=True, exist_ok=True)
    (out / "appearance.json").write_text(json.dumps(result, indent=1) + "\n")
    (out / "appearance.md").write_text(markdown(result))
    return result


def recovery(
    captured: Captured, options: Stage1Options, progress: Progress = silent, seed: int = 0
) -> dict[str, dict[str, dict[str, Any]]]:
    """What is recovered from frames with noise, and with lamps 2 mm and 3 % off their calibration.

    For each case the rows "spatial" (lamps as calibrated) and "lights" (lamps fitted too).
    """
    rng = np.random.default_rng([seed, 9])
    lights = captured.views[0].lights
    off = [
        replace(
            x,
            position=x.position + 2e-3 * rng.normal(size=3) / np.sqrt(3),
            intensity=x.intensity * (1 + 0.03 * rng.normal()),
        )
        for x in lights
    ]
    white = 1 / captured.exposure.scale
    noisy = [
        replace(
            o,
            radiance=(
                o.radiance
                + 0.02 * white * rng.normal(size=o.radiance.shape)
                + np.sqrt(2e-3 * white * np.maximum(o.radiance, 0))
                * rng.normal(size=o.radiance.shape)
            ).astype(np.float32),
        )
        for o in captured.views
    ]
    cases: dict[str, tuple[Captured, Sequence[Light] | None]] = {
        "as captured": (captured, None),
        "noise of 2 % of white and 500 electrons at white": (
            replace(captured, views=tuple(noisy)),
            None,
        ),
        "lamps 2 mm and 3 % off": (captured, off),
    }
    out: dict[str, dict[str, dict[str, Any]]] = {}
    for name, (frames, known) in cases.items():
        table = Table(frames, options, lights=known, progress=named(progress, name), seed=seed)
        rows = table.run(("spatial", "lights"))
        out[name] = {
            row: {
                "psnr_clean": rows[row][GROUPS[1]]["psnr_clean"],
                "beta_m_error": rows[row]["beta_m_error"],
                "sigma_a_error": rows[row]["sigma_a_error"],
            }
            for row in ("HairInverse", "spatial", "lights")
        }
        if known is not None:
            true = np.array([lights[i].intensity[0] for i in captured.train_lights])
            mine = np.array([known[i].intensity[0] for i in captured.train_lights])
            out[name]["spatial"]["lamps_off"] = _relative_spread(mine / true)
            out[name]["lights"]["lamps_off"] = _relative_spread(mine * table.found[1].gain / true)
    return out


def _relative_spread(ratio: Array) -> float:
    """RMS of what lamps differ by from each other: all of them together is the hair's colour."""
    return float(np.std(ratio / ratio.mean()))


def error_against_time(
    captured: Captured, options: Stage1Options, progress: Progress = silent, seed: int = 0
) -> dict[str, list[dict[str, float]]]:
    """Held-out PSNR of "spatial" against CPU seconds: ours, and ours with one choice undone.

    "plain" draws pairs evenly, renders whole frames one at a time to a fixed number of bounces, and
    starts from one colour; of its steps only the first are run. Watching is not counted.
    """
    training = captured.training()
    scale, skin = captured.exposure.scale, captured.skin
    ours = replace(options, row="spatial", check_every=max(2, options.steps // 3))
    even = replace(ours, residual_weighted=False, cell_start=False, shared_paths=False)
    frame = captured.views[0].camera.width * captured.views[0].camera.height
    versions = {
        "ours": ours,
        "one colour first": replace(ours, cell_start=False),
        "common numbers": replace(ours, common_numbers=True),
        "even batches": replace(ours, residual_weighted=False),
        "plain": replace(
            even,
            effort=replace(options.effort, pixels=frame, rr_depth=options.effort.max_depth),
            check_every=1,
            levels=1,
            steps=PLAIN_STEPS,
        ),
    }
    start = HairMaps.of(replace(captured.truth.mean(), sigma_a=(0.3, 0.3, 0.3), beta_m=0.4))
    curves = {}
    for name, version in versions.items():
        progress(f"time: {name}", 0.0)
        views = [_framed(o) for o in training] if name == "plain" else training
        points: list[tuple[float, HairMaps]] = []
        problem = Problem(captured.mapped, views, scale, skin)
        run(
            problem,
            start,
            options=version,
            snapshot=_into(points),
            seed=seed,
        )
        table = Table(captured, options, seed=seed)
        curve = []
        for seconds, maps in points:
            table.score_maps("now", maps, captured.mapped, seconds)
            psnr_clean = table.rows["now"][GROUPS[1]]["psnr_clean"]
            curve.append({"cpu_seconds": seconds, "psnr_clean": psnr_clean})
        curves[name] = curve
    return curves


def _framed(o: Observed) -> Observed:
    """All pixels of the camera, of which those beside the hair do not count."""
    pixels = np.arange(o.camera.width * o.camera.height)
    radiance = np.zeros((len(o.lights), len(pixels), 3), np.float32)
    valid = np.zeros(radiance.shape[:2], bool)
    radiance[:, o.pixels], valid[:, o.pixels] = o.radiance, o.valid
    return Observed(o.camera, o.lights, pixels, radiance, valid)


def _into(points: list[tuple[float, HairMaps]]) -> Callable[[float, HairMaps], None]:
    return lambda seconds, maps: points.append((seconds, maps))


def _final(rows: dict[str, dict[str, Any]]) -> dict[str, float]:
    return {name: row[GROUPS[1]]["psnr_clean"] for name, row in rows.items()}


def markdown(result: dict[str, Any]) -> str:
    """The tables, for people."""
    lines = []
    for name, rows in result["subjects"].items():
        lines += [
            f"## Subject ({name})",
            "",
            "| row | held-out views, lights: PSNR without noise | PSNR | SSIM | training views, "
            "held-out lights: PSNR without noise | β_M off | mean σ off | s |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for row, figures in rows.items():
            held, train = figures[GROUPS[1]], figures[GROUPS[0]]
            off = [
                f"{100 * figures[k]:+.1f} %" if k in figures else ""
                for k in ("beta_m_error", "sigma_a_error")
            ]
            lines.append(
                f"| {row} | {held['psnr_clean']:.2f} | {held['psnr']:.2f} | {held['ssim']:.3f} | "
                f"{train['psnr_clean']:.2f} | {off[0]} | {off[1]} | "
                f"{figures.get('seconds', 0):.0f} |"
            )
        lines.append("")
    for case, rows in result.get("recovery", {}).items():
        for row, found in rows.items():
            lamps = f", lamps {100 * found['lamps_off']:.1f} % off" if "lamps_off" in found else ""
            lines.append(
                f"- {case}, {row}: {found['psnr_clean']:.2f} dB, "
                f"β_M {100 * found['beta_m_error']:+.1f} %, "
                f"σ {100 * found['sigma_a_error']:.1f} %{lamps}"
            )
    for name, curve in result.get("time", {}).items():
        points = ", ".join(f"{p['cpu_seconds']:.0f} s: {p['psnr_clean']:.2f}" for p in curve)
        lines.append(f"- {name}: {points}")
    return "\n".join(lines) + "\n"
