"""The demo's figures over subjects and seeds, from the `results.json` of runs that were made."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from benchmarks.command import Benchmark, LeftOut, option
from benchmarks.results import save
from reconstruction import Progress
from reconstruction.reading import parse_json
from stage_service.cli.support.commands import BadArgument
from stage_service.model_page.names import (
    GROUPS,
    OF_TRUTH,
    PICTURES,
    STRAND_FIGURES,
    STRANDS,
    THRESHOLDS,
    strand_figure,
)

_SCORES = ("psnr", "ssim")
_FIELDS = ("subject", "seed", "geometry", "baselines", "images", "appearance")


def _bench(args: argparse.Namespace, _progress: Progress) -> dict[str, Any]:
    paths = args.results or sorted(Path("runs").glob("*/results.json"))
    if not paths:
        raise LeftOut("no runs/*/results.json: run 'hairstage demo --out runs/NAME' first")
    columns = demo_columns(paths)
    (args.out / "demo.md").write_text(markdown_table(columns))
    result = {
        "seeds": sorted({r["seed"] for results in columns.values() for r in results}),
        "figures": {name: figures_of(results) for name, results in columns.items()},
    }
    save(args.out / "demo.json", result)
    return result


def demo_columns(paths: Sequence[Path]) -> dict[str, list[dict[str, Any]]]:
    """Results of demos by the name of their column: one for each subject, its seeds together.

    Raises `CommandError` for a file that is no demo's.
    """
    by_subject: dict[str, list[tuple[Path, dict[str, Any]]]] = {}
    for path in paths:
        results = _demo_results(path)
        by_subject.setdefault(results["subject"], []).append((path, results))
    columns: dict[str, list[dict[str, Any]]] = {}
    stems = [Path(subject).stem for subject in by_subject]
    for subject, found in by_subject.items():
        if stems.count(Path(subject).stem) == 1:  # strand files by their names
            subject = Path(subject).stem
        seeds = [results["seed"] for _, results in found]
        if len(set(seeds)) == len(seeds):
            many = "s" if len(seeds) > 1 else ""
            name = f"{subject}, seed{many} {', '.join(str(s) for s in sorted(seeds))}"
            columns[name] = [results for _, results in found]
        else:  # versions of one demo, not samples
            for path, results in found:
                columns[f"{subject}, seed {results['seed']} ({path})"] = [results]
    return columns


def _demo_results(path: Path) -> dict[str, Any]:
    try:
        results = parse_json(path.read_bytes())
    except ValueError as e:
        raise BadArgument(f"{path} is not JSON: {e}; give a demo's results.json") from e
    if not isinstance(results, dict):
        raise BadArgument(f"{path} is not a JSON object: not a demo's results.json")
    if absent := [field for field in _FIELDS if field not in results]:
        raise BadArgument(f"{path} has no {', '.join(absent)}: not a demo's results.json")
    try:
        figures_of([results])
    except (KeyError, TypeError, AttributeError, ValueError) as e:
        what = f"no {e}" if isinstance(e, KeyError) else f"a figure of another kind ({e})"
        raise BadArgument(f"{path} has {what} where a demo's results.json has one") from e
    return results


def markdown_table(columns: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """A table of figures: a column for each list of results, one a seed, by its name.

    A cell is the figure of one seed, or mean ± standard deviation (n - 1) over seeds. Warnings
    stand below, each with the seeds that had it; its numbers are those of the first.
    """
    table, notes = [["", *columns], ["---"] * (len(columns) + 1)], []
    for number, (name, results) in enumerate(columns.items(), 1):
        seeds_of: dict[str, list[str]] = {}
        first: dict[str, str] = {}
        for result in results:
            for text in result.get("warnings", []):
                alike = re.sub(r"[\d.]+", "#", text)
                first.setdefault(alike, text)
                seeds_of.setdefault(alike, []).append(str(result["seed"]))
        if first:
            table[0][number] = f"{name} [{number}]"
        for alike, text in first.items():
            of = f" (seed {', '.join(seeds_of[alike])})" if len(results) > 1 else ""
            notes.append(f"[{number}] {text}{of}")
    figures = [figures_of(results) for results in columns.values()]
    for title, parts in _rows().items():
        cells = [" / ".join(_cell(f[title], parts)) if title in f else "–" for f in figures]
        if set(cells) != {"–"}:
            table.append([title, *cells])
    return "\n\n".join(["\n".join(f"| {' | '.join(row)} |" for row in table), *notes])


def figures_of(results: Sequence[Mapping[str, Any]]) -> dict[str, list[dict[str, float]]]:
    """The rows of `markdown_table` as numbers, of one seed or several.

    `{row: [{"mean", "n", "std"}, …]}`: of pictures PSNR and SSIM, else one; "std" of several seeds.
    """
    out = {}
    for title, parts in _rows().items():
        values = [[read(result) for result in results] for read, _, _ in parts]
        if not any(v is None for of_part in values for v in of_part):
            out[title] = [
                _summary([float(v) for v in of_part if v is not None]) for of_part in values
            ]
    return out


def _summary(values: Sequence[float]) -> dict[str, float]:
    spread = {"std": stdev(values)} if len(values) > 1 else {}
    return {"mean": mean(values), "n": len(values), **spread}


_Part = tuple[Callable[[Mapping[str, Any]], float | None], str, str]
"""A figure of a result, None where it has none; the form of the number, and its unit."""


def _rows() -> dict[str, list[_Part]]:
    """The table's rows by title."""
    rows: dict[str, list[_Part]] = {}
    for over in ("visible", "all"):
        for at, how in (("", ""), ("equal_length", ", at equal length")):
            for name, title in STRANDS.items():
                read = partial(_f, at=at, over=over, name=name)
                rows[f"F at 1 mm/10°, {over} points{how}: {title}"] = [(read, ".1f", " %")]
    for title, form, unit, place in STRAND_FIGURES:
        for name, who in STRANDS.items():
            figure = partial(_strand_figure, place=place, name=name)
            rows[f"{title}: {who}"] = [(figure, form, unit)]
        if title in OF_TRUTH:
            truth = partial(_strand_figure, place=OF_TRUTH[title], name="ours")
            rows[f"{title}: the truth"] = [(truth, form, unit)]
    for group in GROUPS:
        for name, title in PICTURES.items():
            decibels, ssim = (partial(_score, group=group, name=name, score=s) for s in _SCORES)
            where = group.replace("held_out_", "held-out ")
            rows[f"{where}: {title}"] = [(decibels, ".1f", " dB"), (ssim, ".2f", "")]
    rows["β_M to render these strands with"] = [(partial(_beta_m, fit="fitted"), ".2f", "")]
    rows["β_M of Sun's fit: standard error"] = [(_beta_m_error, ".2f", "")]
    rows["β_M of the fibres: the truth"] = [(partial(_beta_m, fit="true"), ".2f", "")]
    rows["σ_a, the channel that is furthest off"] = [(_absorption_error, ".0f", " %")]
    return rows


def _cell(figures: Sequence[Mapping[str, float]], parts: Sequence[_Part]) -> Iterator[str]:
    for one, (_, form, unit) in zip(figures, parts, strict=True):
        spread = f" ± {one['std']:{form}}" if "std" in one else ""
        yield f"{one['mean']:{form}}{spread}{unit}"


def _f(results: Mapping[str, Any], at: str, over: str, name: str) -> float | None:
    scores = _scores_of(results, name)
    if scores is None or (at and at not in scores):
        return None  # of an earlier version
    return 100 * float((scores[at] if at else scores)[over][THRESHOLDS[0]]["f"])


def _strand_figure(results: Mapping[str, Any], place: Sequence[str], name: str) -> float | None:
    scores = _scores_of(results, name)
    return None if scores is None else strand_figure(scores, place)


def _scores_of(results: Mapping[str, Any], name: str) -> Mapping[str, Any] | None:
    found: Mapping[str, Any] | None = {"ours": results["geometry"], **results["baselines"]}.get(
        name
    )
    return found


def _score(results: Mapping[str, Any], group: str, name: str, score: str) -> float | None:
    found = results["images"].get(group, {}).get(name)
    return None if found is None else float(found[score])


def _beta_m(results: Mapping[str, Any], fit: str) -> float | None:
    found = results["appearance"].get(fit)
    return None if found is None else float(found["beta_m"])


def _beta_m_error(results: Mapping[str, Any]) -> float | None:
    """Standard error of the roughness of Sun's fit; None in results without one."""
    fits = results["appearance"]
    sun = fits.get("sun_fit", fits["fitted"])
    return sun["beta_m"] * sun["beta_m_error"] if "beta_m_error" in sun else None


def _absorption_error(results: Mapping[str, Any]) -> float | None:
    """By how much, in per cent, the channel of σ_a is off that is furthest from the truth."""
    fits = results["appearance"]
    fitted, true = (fits.get(fit, {}).get("sigma_a") for fit in ("fitted", "true"))
    if not fitted or not true or not all(true):
        return None
    return 100 * max(abs(a / b - 1) for a, b in zip(fitted, true, strict=True))


RESULTS = option("--results", "of demos; default: runs/*/results.json", type=Path, nargs="+")
BENCHMARK = Benchmark(_bench, (RESULTS,))
