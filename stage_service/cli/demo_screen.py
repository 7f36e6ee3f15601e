"""The last screen of `hairstage demo`: result, three figures, warnings to act on, what to open."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from textwrap import wrap
from typing import Any

from stage_service.model_page.names import PICTURES, STRANDS

WIDTH = 118
MOST_WARNINGS = 4
F_THRESHOLD = "1mm_10deg"
STRAND_BASELINES = ("hull_smooth_field", "hull_vertical")
PICTURE_BASELINES = (
    *("diffuse", "mean_colour", "three_nearest"),
    *("nearest_cameras", "three_nearest_own_frames"),
)
ACTION = re.compile(
    r"(?:[:;,.] |\b(?:and|or|until you) )"
    r"(?:add|check|give|import|look at|move|provide|set|shoot|turn|use)\b"
)
"""An imperative that begins a clause: the warning needs an action."""


def last_screen(results: Mapping[str, Any], out: Path) -> str:
    """At most 25 lines on the demo's `results.json` in `out`; the model's page has all tables."""
    model = out.resolve() / "model"
    turning = model / "relit.webp"
    relit = (turning, "turning") if turning.exists() else (model / "relit.png", "new")
    stages = ", ".join(f"{name} {s:.0f} s" for name, s in results["stages"].items())
    title = f"{results['subject']}, seed {results['seed']}, rig {results['rig']}"
    lines = [
        f"{title}: done in {results['seconds']:.0f} s",
        f"capture {results['capture']['seconds']:.0f} s, {stages}",
        *([results["label"]] if "label" in results else []),
        "",
        _result(results),
        "",
        f"{'':<42}{'ours':>9}  best baseline",
        *_figures(results),
        "",
        *_warnings(results["warnings"]),
        "Open next",
        f"  {model / 'index.html'}: every table, picture and warning",
        f"  {relit[0]}: the hair under a {relit[1]} environment",
        f"  hairstage view {out / 'model'} --capture {out / 'capture'} "
        f"--truth {out / 'truth' / 'strands.npz'}",
        f"  hairstage export {out / 'model'} --to blender --out {out / 'blender'}",
    ]
    return "\n".join(lines)


def _result(results: Mapping[str, Any]) -> str:
    lengths, fits = results["geometry"]["lengths"]["pred"], results["appearance"]
    fitted = fits["fitted"]
    text = f"{lengths['strands']:,} strands, {lengths['total_m']:,.0f} m; beta_m "
    text += f"{fitted['beta_m']:.2f}"
    if interval := fitted.get("beta_m_interval"):
        text += f" (95 % interval {interval[0]:.2f} to {interval[1]:.2f})"
    return f"{text}, true {fits['true']['beta_m']:.2f}" if "true" in fits else text


def _figures(results: Mapping[str, Any]) -> Iterator[str]:
    def f_score(scores: Mapping[str, Any]) -> float:
        return 100 * float(scores["visible"][F_THRESHOLD]["f"])

    found = {n: f_score(s) for n, s in results["baselines"].items() if n in STRAND_BASELINES}
    yield _row("strands: F at 1 mm/10°, visible", f_score(results["geometry"]), found, STRANDS, "%")
    for group in ("held_out_lights", "held_out_camera"):
        images = results["images"].get(group, {})
        if "ours" in images:
            psnr = {n: images[n]["psnr"] for n in PICTURE_BASELINES if n in images}
            title = f"images: PSNR, {group.replace('held_out_', 'held-out ')}"
            yield _row(title, images["ours"]["psnr"], psnr, PICTURES, "dB")


def _row(
    title: str, ours: float, others: Mapping[str, float], names: Mapping[str, str], unit: str
) -> str:
    text = f"{title:<42}{ours:6.1f} {unit:<2}"
    if not others:
        return f"{text}  not computed"
    best = max(others, key=lambda name: others[name])
    return f"{text}  {others[best]:.1f} {unit}, {names[best]}"


def _warnings(warnings: list[str]) -> Iterator[str]:
    """Those that need an action, in two lines each, and the number of others."""
    act = [w for w in warnings if ACTION.search(w)]
    more = len(warnings) - len(act[:MOST_WARNINGS])
    others = f"; {more} more on the model's page" if more else ""
    yield f"Warnings to act on: {len(act) or 'none'}{others}"
    for text in act[:MOST_WARNINGS]:
        first, *rest = wrap(text, WIDTH, subsequent_indent="    ", max_lines=2, placeholder=" …")
        yield from (f"  {first}", *rest)
    yield ""
