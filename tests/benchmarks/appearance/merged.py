"""Table 1 of several runs of `bench appearance --size`: a table a ladder, a column a subject."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.appearance.known_subjects import RECONSTRUCTED
from benchmarks.appearance.table import GROUPS, TRUTH
from benchmarks.results import markdown
from reconstruction.reading import parse_json
from stage_service.cli.support.commands import BadArgument

LADDERS = {
    RECONSTRUCTED: "Reconstructed strands",
    "b": "True strands",
    "c": "True strands, bent by 5° RMS",
    "cycles": "Frames of Blender Cycles, true strands",
}
VARIANTS = {
    "mean colour": "mean colour",
    "three nearest": "three nearest lights",
    "GaussianHair": "GaussianHair: a field alone, degree 3",
    "HairInverse": "HairInverse: Sun's one colour",
    "shared": "original BSDF: one colour",
    "spatial": "+ spatial",
    "correctives": "+ correctives",
    "lights": "+ lights",
    "full": "full: + field",
    TRUTH: "the truth, rendered again",
}
"""Names of the table's rows by those of variants, in the order of GroomLight's Table 1."""
_ERRORS = {
    "β_M off, in the end": ("lights", "beta_m_error"),
    "β_N off, in the end": ("lights", "beta_n_error"),
    "visible σ_a off, median, HairInverse": ("HairInverse", "visible_sigma_a_error"),
    "visible σ_a off, median, in the end": ("lights", "visible_sigma_a_error"),
    "factors of lights, spread": ("lights", "gain_spread"),
}
Run = Mapping[str, Any]
"""Variants of one seed of the fit."""


def read_results(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """`appearance_SIZE.json` of runs. Raises `BadArgument` for other files and for a column that
    two of them have."""
    wanted = "give appearance_SIZE.json of 'hairstage bench appearance --size SIZE'"
    found, columns = [], set[tuple[str, ...]]()
    for path in paths:
        try:
            result = parse_json(path.read_bytes())
            if not merged([result]).count("## "):
                raise ValueError("no runs")
        except OSError as e:
            raise BadArgument(f"{path} cannot be read ({e.strerror}): {wanted}") from e
        except (ValueError, TypeError, KeyError, AttributeError) as e:
            what = f"it has no {e}" if isinstance(e, KeyError) else e
            raise BadArgument(f"{path} is not a run's ({what}): {wanted}") from e
        for ladder in {name.split(",")[0] for name in result["subjects"]}:
            column = (ladder, result["subject"], result["commit"])
            if column in columns:
                raise BadArgument(
                    f"{path} has ladder {ladder} of {result['subject']} at {result['commit']}, "
                    "as another file has: give one of them"
                )
            columns.add(column)
        found.append(result)
    return found


def merged(results: Sequence[Mapping[str, Any]]) -> str:
    """Markdown of the ladders that `results` have: those of `appearance_SIZE.json`."""
    rig = results[0]["rig"]
    lines = [
        "Frames of dyed hair (dark roots, fair tips, wisps of two dyes) under held-out lights. dB",
        "without noise in held-out views ± spread over seeds of the fit / in training views / SSIM",
        "in held-out views; then how many seeds keep the stage. If none does, its row repeats the",
        f"one above. Hair only, {rig['size']}²: {rig['cameras'] - 2} training, 2 held-out views,",
        f"{rig['lights'] // 2} training and {rig['lights'] - rig['lights'] // 2} held-out lights.",
        f"A column's run: `--size {rig['size']} --ladders LADDER --seeds SEEDS --subject SUBJECT`,",
        "at its commit; of reconstructed strands with `--strands FILE`.",
    ]
    for ladder, title in LADDERS.items():
        columns = {
            f"{r['subject']}, `{r['commit']}`": _runs(r, ladder)
            for r in results
            if _runs(r, ladder)
        }
        if columns:
            rows = _rows(list(columns.values()))
            lines += ["", f"## {title}", "", markdown(["variant", *columns], rows).rstrip()]
    return "\n".join(lines) + "\n"


def figures_of(result: Mapping[str, Any]) -> dict[str, Any]:
    """What the tables have of a run's results, and its decisions."""
    wanted = (*GROUPS, "decision", "seconds", "cpu_seconds", *(key for _, key in _ERRORS.values()))
    subjects = {
        run: {name: {k: v[k] for k in wanted if k in v} for name, v in variants.items()}
        for run, variants in result["subjects"].items()
    }
    return {**{k: result[k] for k in ("subject", "commit")}, "subjects": subjects}


def _runs(result: Mapping[str, Any], ladder: str) -> list[Run]:
    """The ladder's runs, one a seed."""
    return [v for name, v in result["subjects"].items() if name.split(",")[0] == ladder]


def _rows(columns: Sequence[Sequence[Run]]) -> Iterator[list[str]]:
    for variant, label in VARIANTS.items():
        if all(variant in run for runs in columns for run in runs):
            yield [label, *(_score([run[variant] for run in runs], variant) for runs in columns)]
    for label, (variant, key) in _ERRORS.items():
        yield [label, *(_per_cent([run[variant][key] for run in runs]) for runs in columns)]
    yield ["CPU s, Sun to lights", *(f"{np.mean([*map(_seconds, runs)]):.0f}" for runs in columns)]


def _score(figures: Sequence[Mapping[str, Any]], variant: str) -> str:
    train, held = ([f[group]["psnr_clean"] for f in figures] for group in GROUPS)
    ssim = np.mean([f[GROUPS[1]]["ssim"] for f in figures])
    spread = f" ± {np.std(held, ddof=1):.1f}" if len(held) > 1 else ""
    kept = [f["decision"]["kept"] for f in figures if "decision" in f]
    of = f", {sum(kept)} of {len(kept)}" if kept and variant != "GaussianHair" else ""
    return f"{np.mean(held):.1f}{spread} / {np.mean(train):.1f} / {ssim:.2f}{of}"


def _per_cent(values: Sequence[float]) -> str:
    return ", ".join(f"{100 * x:.0f}" for x in values) + " %"


def _seconds(run: Run) -> float:
    fits = (run[x] for x in ("HairInverse", "shared", "spatial", "correctives", "lights"))
    return sum(x.get("cpu_seconds", x["seconds"]) for x in fits)
