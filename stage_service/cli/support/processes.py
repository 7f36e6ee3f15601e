"""What `serve`, `worker`, `simulate` and `demo` share."""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path

from stage_service.cli.support.commands import rig_path

RIG_HELP = "rig file, or one that comes with hairstage: demo, stage331"


def add_subject(parser: argparse.ArgumentParser) -> None:
    """Add the options that say which subject sits in which rig."""
    parser.add_argument("--rig", type=rig_path, default="demo", help=RIG_HELP)
    parser.add_argument("--subject", default="wavy", help="wavy, straight, curly or a strand file")
    parser.add_argument("--head", type=Path, help="head mesh (.obj) for a strand file")
    parser.add_argument("--seed", type=int, default=0)


def exit_on_sigterm() -> None:
    """Make SIGTERM end the process as `sys.exit` does: every `finally` runs.

    SIGHUP, a terminal that is closed, counts as SIGTERM unless it is ignored (nohup).
    """
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:
        signal.signal(signal.SIGHUP, lambda *_: signal.raise_signal(signal.SIGTERM))


def log_to_stderr() -> None:
    """Log records of level INFO and above go to stderr."""
    import logging

    logging.basicConfig(
        stream=sys.stderr,
        level=logging.INFO,
        format="%(asctime)s %(levelname)s %(name)s: %(message)s",
    )
