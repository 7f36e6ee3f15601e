"""`hairstage stage`: state of the lamps, and blackout."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from stage_service.cli.support.commands import FAILED, Commands, Output, add_group
from stage_service.cli.support.remote import add_remote

if TYPE_CHECKING:
    from stage_service.cli.support.client import ServiceClient


def add(commands: Commands) -> None:
    """Add the commands."""
    stage = add_group(commands, "stage", "show whether a stage is dark, and black it out")
    add_remote(stage, "status", run_status)
    add_remote(stage, "blackout", run_blackout)
    acknowledge = add_remote(stage, "acknowledge", run_acknowledge)
    acknowledge.add_argument("name", metavar="NAME", help="who inspected the stage")
    acknowledge.add_argument("note", metavar="NOTE", help="what was observed")


def run_status(_args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Show the state of service, lamps and jobs.

    As `GET /health`: "ok", "degraded" (with the problems) or "unsafe": a blackout has failed, and
    no lamp may be lit until it is resolved. The lamps' state is unknown during a blackout, and with
    a light bank that cannot read back.
    """
    health = service.get("/health")
    doing = f"capture {health['capture']} runs" if health["capture"] else "no capture runs"
    worker = "a worker runs" if health["worker"] else "no worker runs"
    lines = [f"{health['status']}: lamps {health['lamps']}, {doing}, {worker}", *health["problems"]]
    if health["latch"] is None and health["lamps"] not in ("dark", "in use"):
        lines.append(health["lamps_detail"])
    output.result(health, "\n".join(lines))


def run_blackout(_args: argparse.Namespace, output: Output, service: ServiceClient) -> int:
    """Put all lamps and projectors off, and report whether they are.

    Aborts a running capture. Exit code 1 if the result is unverified.
    """
    result = service.post("/devices/blackout")
    output.result(result, f"{result['state']}: {result['detail']}")
    return 0 if result["safe"] else FAILED


def run_acknowledge(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Record a person's observation that the lamps are dark.

    Only for light banks that cannot read back; for others a blackout verifies it.
    """
    body = {"name": args.name, "note": args.note}
    output.result(service.post("/devices/acknowledge", body), "recorded in the audit log")
