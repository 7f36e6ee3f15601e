"""`bench`: runs the benchmarks of a checkout, which are no part of the installed package."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

from stage_service.cli.support.commands import FAILED, CommandError, Commands, Output
from stage_service.signals import tied

BENCHMARKS = {
    "acquisition": "steps and bytes a second beside what wires and disk allow",
    "agreement": "a capture that Blender Cycles rendered, from its true strands",
    "appearance": "inverse rendering and its ablations on subjects of known appearance",
    "backends": "BSDF, OLAT, stage 1 and line stereo on CPU and GPU: seconds, agreement",
    "bsdf": "our hair BSDF beside Mitsuba's: tables and pictures",
    "callers": "load x caller x fault: seconds to a blackout, how much slower a capture is",
    "captures": "10,000 captures in a root: the service's start, and a page of them",
    "console": "a capture and an idle service, beside three open pages, streams of events, nobody",
    "demo": "the demo over subjects and seeds beside its baselines, from runs that were made",
    "exports": "a model opened, rendered and written by Blender, beside ours",
    "fields": "fields of reflectance beside baselines on new lights and views",
    "frames": "the simulators' frames beside many paths: error against run time",
    "importing": "strands of a capture written out as photographs, by damage",
    "interpolation": "captured frames interpolated on strands, standard and guided by a model",
    "large": "captures of 1.3 and 20 megapixels: seconds and memory beside their estimate",
    "light_codes": "line stereo with and without lightcodes, and fused, on patches of two heads",
    "light_planes": "strands of three subjects, still and drifting, beside baselines",
    "masks": "automatic hair masks beside true ones, at several path counts",
    "renderers": "our renderers beside Mitsuba's path integrator, light by light and line by line",
    "soak": "a service that shoots for an hour and is killed: memory, frames, blackouts",
    "viewer": "the viewer's light beside the path tracer's; frames a second, and its shader's cost",
    "all": "every one of them",
}
"""What each is about, for `python -m benchmarks` and its help too."""


def add(commands: Commands) -> None:
    """Add the command."""
    bench = commands.add_parser(
        "bench",
        help="measure error against run time (in a checkout)",
        description="Run a benchmark of the checkout; what follows NAME is its own.",
        epilog="\n".join(f"  {name:<14}{text}" for name, text in BENCHMARKS.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    bench.add_argument("name", choices=tuple(BENCHMARKS), metavar="NAME")
    bench.add_argument("arguments", nargs=argparse.REMAINDER)
    bench.set_defaults(run=run_bench, json=False)


def run_bench(args: argparse.Namespace, output: Output) -> int:
    """Run `python -m benchmarks` of the checkout that this package lies in."""
    tests = Path(__file__).resolve().parents[2] / "tests"
    if not (tests / "benchmarks").is_dir():
        raise CommandError(
            "benchmarks are not installed: they are in tests/benchmarks of the repository; run "
            "'make bench', or 'hairstage bench NAME' of an editable installation, in a checkout",
            FAILED,
        )
    # tests/ has folders of the packages' names: the packages come first, wherever this is run.
    path = os.pathsep.join(
        [str(tests.parent), str(tests), *filter(None, [os.environ.get("PYTHONPATH")])]
    )
    command = [sys.executable, "-m", "benchmarks", args.name, *args.arguments]
    return subprocess.run(tied(command), env={**os.environ, "PYTHONPATH": path}).returncode
