"""`hairstage worker`: takes jobs off the queue."""

from __future__ import annotations

import argparse
from pathlib import Path

from stage_service.cli.support import Commands, Output, add_command
from stage_service.cli.support.processes import log_to_stderr


def add(commands: Commands) -> None:
    """Add the command."""
    worker = add_command(
        commands,
        "worker",
        run_worker,
        "run a worker: takes jobs off the queue",
        "Run the jobs of one root folder. A worker that dies leaves its job to the next worker, "
        "which goes on at the step that was under way.",
    )
    worker.add_argument("--root", type=Path, default=Path("runs/stage"), help="as the service's")
    worker.add_argument("--concurrency", type=int, default=1, help="jobs at the same time")


def run_worker(args: argparse.Namespace, output: Output) -> int:
    """Work until a signal."""
    log_to_stderr()
    from stage_service.jobs.worker import run_worker as work

    args.root.mkdir(parents=True, exist_ok=True)
    work(
        args.root,
        concurrency=args.concurrency,
        ready=lambda name: output.result(
            {"worker": name, "root": str(args.root)}, f"{name} works on the jobs of {args.root}"
        ),
    )
    return 0
