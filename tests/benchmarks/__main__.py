"""`python -m benchmarks NAME`, or `hairstage bench NAME`: error against run time."""

from __future__ import annotations

import argparse
import sys
import time
from importlib import import_module

from benchmarks.command import Benchmark, LeftOut
from benchmarks.publish import check_tree, publish
from stage_service.cli.bench import BENCHMARKS
from stage_service.cli.support.commands import (
    FAILED,
    CommandError,
    Output,
    add_command,
    progress_bar,
    run_command,
)

MODULES = {
    "acquisition": "benchmarks.acquisition.rates",
    "agreement": "benchmarks.renderers.agreement",
    "appearance": "benchmarks.appearance.ablations",
    "backends": "benchmarks.backends.side_by_side",
    "bsdf": "benchmarks.bsdf.mitsuba_comparison",
    "callers": "benchmarks.service.callers",
    "cost": "benchmarks.renderers.cost",
    "demo": "benchmarks.demo",
    "error_parts": "benchmarks.appearance.error_parts",
    "exports": "benchmarks.exports.blender",
    "fields": "benchmarks.fields.modulation",
    "frames": "benchmarks.renderers.frames",
    "importing": "benchmarks.importing.damages",
    "interpolation": "benchmarks.fields.interpolation",
    "large": "benchmarks.importing.large_sizes",
    "light_codes": "benchmarks.light_codes.patches",
    "light_planes": "benchmarks.light_planes.subjects",
    "masks": "benchmarks.light_planes.masks",
    "motion": "benchmarks.appearance.motion",
    "patterns": "benchmarks.appearance.patterns",
    "pixels": "benchmarks.pixels.study",
    "publish-set": "benchmarks.publishing.published_set",
    "renderers": "benchmarks.renderers.errors",
    "soak": "benchmarks.service.soak",
    "viewer": "benchmarks.viewer.shown",
}
"""Each has its `BENCHMARK`."""


def main(argv: list[str] | None = None) -> int:
    """Run one benchmark, or all; returns the exit code."""
    argv = sys.argv[1:] if argv is None else argv
    parser = argparse.ArgumentParser(prog="hairstage bench")
    commands = parser.add_subparsers(metavar="NAME", required=True)
    for name, text in BENCHMARKS.items():
        command = add_command(commands, name, run_bench, text)
        command.set_defaults(name=name, arguments=argv[1:])
        chosen = argv[:1] == [name]  # the others' modules need not be loaded
        for benchmark in _benchmarks(name).values() if chosen else ():
            benchmark.add_options(command)
    return run_command(parser, argv)


def _benchmarks(name: str) -> dict[str, Benchmark]:
    """The benchmark of that name, or every one for "all"."""
    names = list(MODULES) if name == "all" else [name]
    return {n: import_module(MODULES[n]).BENCHMARK for n in names}


def run_bench(args: argparse.Namespace, output: Output) -> int:
    """Run one benchmark, or all; of all, those go without that lack their data."""
    args.out.mkdir(parents=True, exist_ok=True)
    results = {}
    commit = check_tree(args.quick) if args.publish else ""
    for name, benchmark in _benchmarks(args.name).items():
        try:
            begun = time.monotonic()
            with progress_bar(f"bench {name}") as progress:
                results[name] = benchmark.run(args, progress)
            if args.publish:
                took = time.monotonic() - begun
                page = publish(name, results[name], args.arguments, args.out, took, commit)
                output.note(f"published {page}")
        except LeftOut as error:
            if args.name != "all":
                raise CommandError(f"bench {name}: {error}", FAILED) from error
            results[name] = {"left_out": str(error)}
    output.result(results)
    return 0


if __name__ == "__main__":
    sys.exit(main())
