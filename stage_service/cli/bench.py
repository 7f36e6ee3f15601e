"""`bench`: runs the benchmarks of a checkout; the installed package has none."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

from stage_service.cli.support.children import end
from stage_service.cli.support.commands import FAILED, CommandError, Commands, Output
from stage_service.signals import tied

BENCHMARKS = {
    "acquisition": "steps and bytes a second compared with the limits of wires and disk",
    "agreement": "a capture that Blender Cycles rendered, from its true strands",
    "appearance": "inverse rendering and its ablations on subjects of known appearance",
    "backends": "BSDF, OLAT, inverse rendering and line stereo on CPU and GPU: seconds, agreement",
    "bsdf": "our hair BSDF compared with Mitsuba's: tables and images",
    "callers": "load x caller x fault: seconds to a blackout, how much slower a capture is",
    "cost": "frames and fits by size: seconds and memory compared with the estimates",
    "demo": "recorded demos over subjects and seeds compared with their baselines",
    "error_parts": "a demo's error on held-out frames, part by part replaced by the truth",
    "exports": "a model opened, rendered and written by Blender, compared with ours",
    "fields": "fields of reflectance compared with baselines on new lights and views",
    "frames": "the simulated frames compared with many paths: error against run time",
    "importing": "strands of a capture written out as photographs, by damage",
    "interpolation": "captured frames interpolated on strands, standard and guided by a model",
    "large": "captures of 1.3 and 20 megapixels: seconds and memory compared with the estimate",
    "light_codes": "line stereo with and without lightcodes, and fused, on patches of two heads",
    "light_planes": "strands of three subjects, still and drifting, compared with baselines",
    "masks": "automatic hair masks compared with true ones, at several path counts",
    "motion": "single lights of a moving subject, stabilised by lit frames, compared with still",
    "patterns": "patterns of lights compared with single lights, at equal exposure time",
    "pixels": "strands of patches of fine hair at pixels of 1.8 to 0.25 mm, with baselines",
    "publish-set": "captures with true strands in open formats, with a scorer; read back, scored",
    "renderers": "our renderers compared with Mitsuba's path integrator, light by light",
    "soak": "a service that shoots for an hour and is killed: memory, frames, blackouts",
    "viewer": "the viewer compared with the path tracer; frames a second; cost of its shader",
    "all": "every one of them",
}
"""What each measures; `python -m benchmarks` prints it too."""


def add(commands: Commands) -> None:
    """Add the command."""
    bench = commands.add_parser(
        "bench",
        help="measure error against run time (in a checkout)",
        description="Run a benchmark of the checkout; arguments after NAME go to it.",
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
    # tests/ has folders with the packages' names, so the packages come first
    path = os.pathsep.join(
        [str(tests.parent), str(tests), *filter(None, [os.environ.get("PYTHONPATH")])]
    )
    command = [sys.executable, "-m", "benchmarks", args.name, *args.arguments]
    environment = {**os.environ, "PYTHONPATH": path}
    child = subprocess.Popen(tied(command), env=environment, text=True, start_new_session=True)
    try:
        return child.wait()
    finally:
        end(child)
