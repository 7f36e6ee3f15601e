"""The command line: `hairstage COMMAND`. Commands import what they need when they run."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from stage_service.cli import (
    bench,
    calibrate,
    captures,
    demo_command,
    evaluate,
    heads,
    models,
    processes,
    remote,
    rigs,
)
from stage_service.cli.output import EXIT_CODES
from stage_service.cli.runner import run_command


def build_parser() -> argparse.ArgumentParser:
    """The whole command line, for `main` and for tests."""
    codes = "\n".join(f"  {code:<4}{meaning}" for code, meaning in EXIT_CODES.items())
    parser = argparse.ArgumentParser(
        prog="hairstage",
        description="Runs a hair light stage and turns its captures into strands and relit hair.",
        epilog=f"exit codes:\n{codes}\n\nResults go to stdout, progress to stderr.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for group in (
        demo_command,
        processes,
        remote,
        captures,
        models,
        evaluate,
        bench,
        rigs,
        calibrate,
        heads,
    ):
        group.add(commands)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code (see `hairstage --help`)."""
    return run_command(build_parser(), argv)
