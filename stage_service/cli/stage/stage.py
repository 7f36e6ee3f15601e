"""`hairstage stage`: whether it is dark, and how to make it so."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from stage_service.cli.support.commands import FAILED, Commands, Output, add_group, add_remote

if TYPE_CHECKING:
    from stage_service.cli.support.client import ServiceClient


def add(commands: Commands) -> None:
    """Add the commands."""
    stage = add_group(commands, "stage", "see whether a stage is dark, and make it so")
    add_remote(stage, "status", run_status)
    add_remote(stage, "blackout", run_blackout)
    acknowledge = add_remote(stage, "acknowledge", run_acknowledge)
    acknowledge.add_argument("name", metavar="NAME", help="who has looked")
    acknowledge.add_argument("note", metavar="NOTE", help="what they saw")


def run_status(_args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Show how service, lamps and jobs are.

    As `GET /health` has it: "ok", "degraded" (with what is wrong) or "unsafe": a blackout has
    failed, and nothing may be lit until that is over. What is known of the lamps stands beside it:
    unknown, too, during a blackout and where the light bank cannot read back.
    """
    health = service.get("/health")
    doing = f"capture {health['capture']} runs" if health["capture"] else "no capture runs"
    worker = "a worker is there" if health["worker"] else "no worker is there"
    lines = [f"{health['status']}: lamps {health['lamps']}, {doing}, {worker}", *health["problems"]]
    if health["latch"] is None and health["lamps"] not in ("dark", "in use"):
        lines.append(health["lamps_detail"])
    output.result(health, "\n".join(lines))


def run_blackout(_args: argparse.Namespace, output: Output, service: ServiceClient) -> int:
    """Put all lamps and projectors off, and say whether they are.

    Aborts a running capture. Exit code 1 where nobody knows whether they are off.
    """
    result = service.post("/devices/blackout")
    output.result(result, f"{result['state']}: {result['detail']}")
    return 0 if result["safe"] else FAILED


def run_acknowledge(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Say that somebody has looked: the lamps are off.

    Only where the link cannot tell by itself; elsewhere a blackout does.
    """
    body = {"name": args.name, "note": args.note}
    output.result(service.post("/devices/acknowledge", body), "said, and in the audit log")
