"""The command line `hairstage COMMAND`, a file for each command; `import` is in `verify.py`,
`serve`, `worker` and `simulate` are in `stage/processes.py`. Commands import their libraries when
they run."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib.metadata import version

from stage_service.cli import bench, calibrate, demo, doctor, head, rig, verify
from stage_service.cli.model import edit, evaluate, export, fit, page, reconstruct, render, view
from stage_service.cli.stage import capture, jobs, lease, processes, queue, stage, store, tokens
from stage_service.cli.support.commands import EXIT_CODES, run_command

COMMANDS = (
    *(demo, doctor, processes, stage, capture, queue, lease, jobs, store, tokens),
    *(verify, reconstruct, fit, render, view, edit, export, page),
    *(evaluate, bench, rig, calibrate, head),
)


def build_parser() -> argparse.ArgumentParser:
    """The whole command line, for `main` and for tests."""
    codes = "\n".join(f"  {code:<4}{meaning}" for code, meaning in EXIT_CODES.items())
    parser = argparse.ArgumentParser(
        prog="hairstage",
        description="Runs a hair light stage and turns its captures into strands and relit hair.",
        epilog=f"exit codes:\n{codes}\n\nResults go to stdout, progress to stderr.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"hairstage {version('hairstage')}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for command in COMMANDS:
        command.add(commands)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code (see `hairstage --help`)."""
    return run_command(build_parser(), argv)
