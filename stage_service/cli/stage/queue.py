"""`hairstage queue`: queued captures of a running service."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from stage_service.cli.stage.capture import add_requested, requested
from stage_service.cli.support.commands import Commands, Output, add_group, in_url
from stage_service.cli.support.remote import add_remote

if TYPE_CHECKING:
    from stage_service.cli.support.client import ServiceClient


def add(commands: Commands) -> None:
    """Add the commands."""
    queue = add_group(commands, "queue", "captures that start when the stage is free")
    added = add_remote(queue, "add", run_add)
    add_requested(added)
    added.add_argument("--place", type=int, help="position, from 0; default: the end")
    add_remote(queue, "list", run_list_queue)
    add_remote(queue, "history", run_history)
    moved = add_remote(queue, "move", run_move)
    removed = add_remote(queue, "remove", run_remove)
    started = add_remote(queue, "start", run_start_one)
    for parser in (moved, removed, started):
        parser.add_argument("entry", help="its id")
    moved.add_argument("place", type=int, help="position, from 0")
    started.add_argument(
        "--armed-by",
        help="who at the stage is responsible for flashes that the plan has consent for",
    )
    add_remote(queue, "hold", run_hold)
    add_remote(queue, "go-on", run_go_on)


def run_add(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Queue a capture."""
    body = requested(args)
    if args.place is not None:
        body["place"] = args.place
    entry = service.post("/queue", body)
    output.result(entry, f"{entry['id']} is queued")


def run_list_queue(_args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """List the queued captures, the next one first, and why the first is waiting."""
    _show(service.get("/queue"), output)


def run_history(_args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """List captures that were started or removed, the newest first."""
    entries = service.get("/queue/history")
    lines = [f"{e['id']}  {e['state']}  {e['capture'] or ''}  {e['ended']}" for e in entries]
    output.result({"history": entries}, "\n".join(lines) or "nothing yet")


def run_move(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Move a queued capture to another position."""
    output.result(
        service.request("PATCH", f"/queue/{in_url(args.entry)}", json={"place": args.place})
    )


def run_remove(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Remove a queued capture."""
    output.result(service.request("DELETE", f"/queue/{in_url(args.entry)}"))


def run_start_one(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Start a queued capture now, out of order.

    The only way for a plan that flashes: --armed-by names the person at the stage who is
    responsible.
    """
    started = service.post(f"/queue/{in_url(args.entry)}/start", {"armed_by": args.armed_by})
    output.result(started, f"capture {started['capture']} runs")


def run_hold(_args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Hold the queue: no queued capture starts.

    The queue is also held after a start of the service, a blackout, an abort, an incomplete capture
    and a jump of the clock.
    """
    _show(service.post("/queue:hold"), output)


def run_go_on(_args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Release the queue; prints why it was held.

    If another reason to hold it appears meanwhile, it stays held: read the reason and repeat.
    """
    queue = service.get("/queue")
    if queue["hold"] is not None:
        output.note(f"The queue was held: {queue['held']}.")
        queue = service.post("/queue:go-on", {"hold": queue["hold"]["id"]})
    _show(queue, output)


def _show(queue: dict[str, Any], output: Output) -> None:
    lines = [f"{e['id']}  by {e['by']}  {e['added']}" for e in queue["waiting"]]
    if queue["held"]:
        lines.append(f"held: {queue['held']}")
    if queue["waits_for"] and not queue["waits_for"].startswith("held: "):
        lines.append(f"waiting for: {queue['waits_for']}")
    output.result(queue, "\n".join(lines) or "the queue is empty")
