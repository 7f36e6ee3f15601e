"""Inverse rendering and its ablations beside baselines, on subjects of known appearance.

And on the frames that Cycles rendered, where they are. Leaves `appearance.json`, `appearance.md`,
`appearance_cycles.json` and `appearance_cycles_from_afar.json`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from appearance import InverseRenderingOptions
from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering.loop import run
from appearance.inverse_rendering.options import Effort
from appearance.inverse_rendering.problem import FitProblem
from benchmarks.appearance.cycles import AFAR, CyclesFrames, captured_by_cycles, fit_cycles
from benchmarks.appearance.cycles import OPTIONS as CYCLES_OPTIONS
from benchmarks.appearance.known_subjects import (
    RECONSTRUCTED,
    SUBJECTS,
    Captured,
    SmallStage,
    known_subject,
    on_reconstructed,
)
from benchmarks.appearance.merged import figures_of, merged, read_results
from benchmarks.appearance.table import GROUPS, Table
from benchmarks.command import CAPTURE, SUBJECT, Benchmark, LeftOut, cycles_folder, option, within
from benchmarks.publish import commit_of_tree
from benchmarks.results import markdown, save, spread
from benchmarks.subjects import Subject, simulated
from reconstruction import Progress, read_strands, silent
from reconstruction.arrays import Array

OPTIONS = InverseRenderingOptions(
    free_index=True,
    shape=(6, 24, 24),
    effort=Effort(pixels=400, spp=512, max_depth=8),
)
STAGE = SmallStage(size=36, cameras=5, lights=12, spp=12288, judged_spp=1536)
AT_SIZE = {
    size: SmallStage(
        size,
        cameras=views + 2,
        lights=2 * lights,
        spp=24,
        judged_spp=32,
        truth=(12, 96, 96),
        clean_spp=128,
    )
    for size, views, lights in ((128, 8, 24), (256, 16, 64))
}
"""By pixels a side: 8 training views and 24 lights, 16 and 64; the truth is finer than the fit."""
AT_SIZE_OPTIONS = replace(OPTIONS, shape=(12, 24, 24), effort=Effort(pixels=600, spp=64))
STARTS = (
    (0.4, 0.2, 1.45, (0.75, 1.25, 1.3)),
    (0.9, 0.9, 1.55, (1.0, 1.0, 1.0)),
    (0.02, 0.3, 1.55, (1.0, 1.0, 1.0)),
    (0.15, 0.6, 1.55, (8.0, 4.0, 2.0)),
)
"""beta_m, beta_n and eta to start from, and factors on the true absorption."""


@dataclass(frozen=True)
class Ladders:
    """Which tables are made at size: of `subjects`, for `seeds` seeds of the fit.

    (r) needs the `strands` that a reconstruction of the subject made, "cycles" its `capture`.
    `name` is that of the subject whose hair is dyed.
    """

    subjects: Sequence[str] = ("b", "c")
    name: str = "wavy"
    seeds: int = 1
    strands: Path | None = None
    capture: Path | None = None


def run_bench(
    out: Path,
    subject: Subject,
    *,
    seeds: int = 1,
    options: InverseRenderingOptions = OPTIONS,
    rig: SmallStage = STAGE,
    seed: int = 0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """The table of every subject; recovery, also from afar, on (a).

    The variants up to "spatial" of (b) for all `seeds`, with their spread. Writes what there is so
    far into `out`, and returns what `appearance.json` holds.
    """
    result: dict[str, Any] = {"options": asdict(options), "rig": asdict(rig), "subjects": {}}
    captured: Captured | None = None
    for name in SUBJECTS:
        captured = known_subject(name, subject, rig, seed, captured)
        variants = Table(captured, options, progress=within(progress, f"({name})"), seed=seed).run()
        result["subjects"][name] = variants
        _write(out, result)
        if name == "a":
            result["recovery"] = recovery(
                captured, variants, options, within(progress, f"({name})"), seed
            )
            result["starts"] = from_afar(captured, options, within(progress, f"({name})"), seed)
        if name == "b":
            found = [_final(variants)]
            for k in range(1, seeds):
                table = Table(
                    captured, options, progress=within(progress, f"({name})"), seed=seed + k
                )
                found.append(_final(table.run(("shared", "spatial"))))
            shared = [n for n in found[0] if all(n in f for f in found)]
            result["seeds"] = {name: {n: spread([f[n] for f in found]) for n in shared}}
            _write(out, result)
        _write(out, result)
    return result


def run_at_size(
    out: Path, subject: Subject, size: int, runs: Ladders, *, seed: int, progress: Progress = silent
) -> dict[str, Any]:
    """The table of each of `runs.subjects` at `size` of `AT_SIZE`; `appearance_SIZE.json`."""
    rig, options = AT_SIZE[size], AT_SIZE_OPTIONS
    result: dict[str, Any] = {"options": asdict(options), "rig": asdict(rig), "subjects": {}}
    result |= {"subject": runs.name, "commit": commit_of_tree()}
    begun = time.process_time()
    frames: Captured | None = None
    for name in runs.subjects:
        if name == "cycles":
            captured = captured_by_cycles(cycles_folder(runs.capture), seed)
        elif name == RECONSTRUCTED:
            if runs.strands is None:
                raise LeftOut("subject r needs --strands, which a reconstruction of it made")
            frames = frames or known_subject("b", subject, rig, seed)
            captured = on_reconstructed(frames, read_strands(runs.strands), subject)
        else:
            captured = known_subject(name, subject, rig, seed, frames)
            frames = captured if name == "b" else frames
        found = []
        # the index of fibres on strands that are off drifts: users' fits hold it, too
        fit = replace(options, free_index=name != RECONSTRUCTED)
        result.setdefault("free_index", {})[name] = fit.free_index
        for k in range(runs.seeds):
            table = Table(captured, fit, progress=within(progress, f"({name})"), seed=seed + k)
            variants = table.run(fields=name == RECONSTRUCTED)
            found.append(_final(variants))
            result["subjects"][f"{name}, seed of the fit {seed + k}"] = variants
            result["cpu_seconds"] = time.process_time() - begun
            save(out / f"appearance_{size}.json", result)
        result.setdefault("seeds", {})[name] = {n: spread([f[n] for f in found]) for n in found[0]}
        save(out / f"appearance_{size}.json", result)
        (out / f"appearance_{size}.md").write_text(report(result))
    return result


def _write(out: Path, result: dict[str, Any]) -> None:
    save(out / "appearance.json", result)
    (out / "appearance.md").write_text(report(result))


def recovery(
    captured: Captured,
    variants: dict[str, dict[str, Any]],
    options: InverseRenderingOptions,
    progress: Progress = silent,
    seed: int = 0,
) -> dict[str, dict[str, dict[str, Any]]]:
    """What is recovered from frames with noise, and with lights 2 mm and 3 % off their calibration.

    `variants` are those of the table of the frames as they are. The stage "shared" (lights
    as calibrated) and, with lights off, "lights" (lights fitted too).
    """
    rng = np.random.default_rng([seed, 9])
    lights = captured.views[0].single_lights
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
    out = {"as captured": _recovered(variants)}
    name = "noise of 2 % of white and 500 electrons at white"
    table = Table(
        replace(captured, views=tuple(noisy)),
        options,
        progress=within(progress, f"({name})"),
        seed=seed,
    )
    out[name] = _recovered(table.run(("shared",)))
    name = "lights 2 mm and 3 % off"
    table = Table(captured, options, lights=off, progress=within(progress, f"({name})"), seed=seed)
    out[name] = _recovered(table.run(("shared", "lights")))
    true = np.array([lights[i].intensity[0] for i in captured.train_lights])
    known = np.array([off[i].intensity[0] for i in captured.train_lights])
    out[name]["shared"]["lights_off"] = _relative_spread(known / true)
    out[name]["lights"]["lights_off"] = _relative_spread(known * table.found[1] / true)
    return out


def from_afar(
    captured: Captured, options: InverseRenderingOptions, progress: Progress = silent, seed: int = 0
) -> list[dict[str, Any]]:
    """What the stage "shared" finds of one colour from `STARTS`, and in what time."""
    true, out = captured.truth.mean(), []
    problem = FitProblem(
        captured.mapped, captured.training(), captured.exposure.scale, captured.skin
    )
    for beta_m, beta_n, eta, (r, g, b) in STARTS:
        sigma_a = (r * true.sigma_a[0], g * true.sigma_a[1], b * true.sigma_a[2])
        start = replace(true, sigma_a=sigma_a, beta_m=beta_m, beta_n=beta_n, eta=eta)
        progress(f"from β_M {beta_m:g}, β_N {beta_n:g}", 0.0)
        begun = time.process_time()
        found = run(problem, HairMaps.of(start), stages=("shared",), options=options, seed=seed)
        hair = found.maps.mean()
        out.append(
            {
                "start": start.to_dict(),
                "decision": found.decisions[0].to_dict(),
                "beta_m_error": hair.beta_m / true.beta_m - 1,
                "beta_n_error": hair.beta_n / true.beta_n - 1,
                "eta": hair.eta,
                "sigma_a_error": (np.array(hair.sigma_a) / true.sigma_a - 1).tolist(),
                "cpu_seconds": time.process_time() - begun,
            }
        )
    return out


def _recovered(variants: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    wanted = ("beta_m_error", "beta_n_error", "sigma_a_error")
    return {
        name: {"psnr_clean": variant[GROUPS[1]]["psnr_clean"], **{k: variant[k] for k in wanted}}
        for name, variant in variants.items()
        if name in ("HairInverse", "shared", "lights")
    }


def _relative_spread(ratio: Array) -> float:
    """RMS of what lights differ by from each other: all of them together is the hair's colour."""
    return float(np.std(ratio / ratio.mean()))


def _final(variants: dict[str, dict[str, Any]]) -> dict[str, float]:
    return {name: variant[GROUPS[1]]["psnr_clean"] for name, variant in variants.items()}


def report(result: dict[str, Any]) -> str:
    """The tables, for people."""
    head = [
        "variant",
        f"{GROUPS[1]}: PSNR without noise",
        "PSNR",
        "SSIM",
        f"{GROUPS[0]}: PSNR without noise",
        "β_M off",
        "β_N off",
        "most σ off",
        "visible σ off",
        "CPU s",
        "GB",
    ]
    errors = ("beta_m_error", "beta_n_error", "sigma_a_error", "visible_sigma_a_error")
    lines = []
    for name, variants in result["subjects"].items():
        cells = []
        for variant, figures in variants.items():
            held, train = figures[GROUPS[1]], figures[GROUPS[0]]
            scores = [f"{held['psnr_clean']:.2f}", f"{held['psnr']:.2f}", f"{held['ssim']:.3f}"]
            off = [f"{100 * figures[k]:+.1f} %" if k in figures else "" for k in errors]
            seconds = f"{figures.get('cpu_seconds', figures.get('seconds', 0)):.0f}"
            memory = f"{figures.get('memory_gb') or 0:.1f}"
            cells.append([variant, *scores, f"{train['psnr_clean']:.2f}", *off, seconds, memory])
        lines += [f"## Subject ({name})", "", markdown(head, cells)]
    for subject, variants in result.get("seeds", {}).items():
        for name, found in variants.items():
            sd = f" ± {found['sd']:.2f}" if "sd" in found else ""
            mean, count = f"{found['mean']:.2f}", found["seeds"]
            seeds = "one seed" if count == 1 else f"{count} seeds"
            lines.append(f"- ({subject}), {name}: {mean}{sd} dB over {seeds}")
    for case, variants in result.get("recovery", {}).items():
        for variant, found in variants.items():
            off = found.get("lights_off")
            lights = "" if off is None else f", lights {100 * off:.1f} % off"
            lines.append(
                f"- {case}, {variant}: {found['psnr_clean']:.2f} dB, {_off(found)}{lights}"
            )
    for variant in result.get("starts", []):
        start = variant["start"]
        lines.append(
            f"- from β_M {start['beta_m']:g}, β_N {start['beta_n']:g}, η {start['eta']:g}: "
            f"{_off(variant)}, η {variant['eta']:.3f}, {variant['cpu_seconds']:.0f} CPU s"
        )
    return "\n".join(lines) + "\n"


def _off(found: dict[str, Any]) -> str:
    sigma_a = ", ".join(f"{100 * e:+.1f}" for e in np.atleast_1d(found["sigma_a_error"]))
    beta_m, beta_n = (100 * found[f"beta_{x}_error"] for x in "mn")
    return f"β_M {beta_m:+.1f} %, β_N {beta_n:+.1f} %, σ {sigma_a} %"


QUICK = InverseRenderingOptions(
    free_index=True,
    shape=(2, 2, 2),
    effort=Effort(pixels=40, spp=4, max_depth=4),
)
SMALL = SmallStage(size=14, cameras=3, lights=6, spp=64, max_depth=4)


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    if args.results:
        results = read_results(args.results)
        (args.out / "appearance.md").write_text(merged(results))
        fits = sorted({name.split()[-1] for r in results for name in r["subjects"]})
        return {"seeds": ", ".join(fits), "runs": [figures_of(r) for r in results]}
    subject = simulated(args.rig, args.subject, args.head, args.seed)
    if args.size in AT_SIZE and not args.quick:
        runs = Ladders(
            args.ladders.split(","), args.subject, args.seeds, args.strands, args.capture
        )
        known = (*SUBJECTS, RECONSTRUCTED, "cycles")
        if unknown := [name for name in runs.subjects if name not in known]:
            raise ValueError(f"--ladders: no {', '.join(unknown)}; name some of {', '.join(known)}")
        return run_at_size(args.out, subject, args.size, runs, seed=args.seed, progress=progress)
    effort: dict[str, Any] = {"options": QUICK, "rig": SMALL} if args.quick else {}
    seeds = min(args.seeds, 1) if args.quick else args.seeds
    result: dict[str, Any] = {}
    if not args.only_cycles:
        result = run_bench(
            args.out, subject, seeds=seeds, seed=args.seed, progress=progress, **effort
        )
    try:
        folder = cycles_folder(args.capture)
    except LeftOut as error:
        if args.only_cycles:
            raise
        return {**result, "cycles": {"left_out": str(error)}}
    for name, start in (("cycles", None), ("cycles_from_afar", AFAR)):
        frames = CyclesFrames.read(folder, pixels=40 if args.quick else 600, seed=args.seed)
        found = fit_cycles(
            frames, start, options=QUICK if args.quick else CYCLES_OPTIONS, progress=progress
        )
        save(args.out / f"appearance_{name}.json", found)
        result[name] = found
    return result


BENCHMARK = Benchmark(
    _bench,
    (
        *SUBJECT,
        CAPTURE,
        option("--only-cycles", "no tables: what Cycles rendered alone", action="store_true"),
        option("--size", "pixels a side: 36, or the ladder at 128 or 256", type=int, default=36),
        option("--seeds", "of the spread, on (b); at size on all", type=int, default=3),
        option("--ladders", "at size: which of b, c, r and cycles", default="b,c"),
        option("--strands", "at size: those of a reconstruction, for r", type=Path),
        option("--results", "only the tables of these appearance_SIZE.json", type=Path, nargs="+"),
    ),
)
