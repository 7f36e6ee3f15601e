"""`hairstage queue`: captures that wait for the stage of a running service."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from stage_service.cli.stage.capture import add_wanted, wanted
from stage_service.cli.support.commands import Commands, Output, add_group, add_remote, in_url

if TYPE_CHECKING:
    from stage_service.cli.support.client import ServiceClient


def add(commands: Commands) -> None:
    """Add the commands."""
    queue = add_group(
        commands, "queue", "captures that wait for the stage, and begin by themselves"
    )
    added = add_remote(queue, "add", run_add)
    add_wanted(added)
    added.add_argument("--place", type=int, help="where, from 0; without it, at the end")
    add_remote(queue, "list", run_list_queue)
    add_remote(queue, "history", run_history)
    moved = add_remote(queue, "move", run_move)
    removed = add_remote(queue, "remove", run_remove)
    started = add_remote(queue, "start", run_start_one)
    for parser in (moved, removed, started):
        parser.add_argument("entry", help="its id")
    moved.add_argument("place", type=int, help="where, from 0")
    started.add_argument("--armed-by", help="who answers for flashes that the plan has consent for")
    add_remote(queue, "hold", run_hold)
    add_remote(queue, "go-on", run_go_on)


def run_add(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Let a capture wait for the stage."""
    body = wanted(args)
    if args.place is not None:
        body["place"] = args.place
    entry = service.post("/queue", body)
    output.result(entry, f"{entry['id']} waits")


def run_list_queue(_args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """List what waits, the next one first, and what it waits for."""
    _show(service.get("/queue"), output)


def run_history(_args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """List what was started from the queue, or removed; the newest first."""
    entries = service.get("/queue/history")
    lines = [f"{e['id']}  {e['state']}  {e['capture'] or ''}  {e['ended']}" for e in entries]
    output.result({"history": entries}, "\n".join(lines) or "nothing yet")


def run_move(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Put what waits at another place."""
    output.result(service.ask("PATCH", f"/queue/{in_url(args.entry)}", json={"place": args.place}))


def run_remove(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Take out what waits."""
    output.result(service.ask("DELETE", f"/queue/{in_url(args.entry)}"))


def run_start_one(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Start what waits now, out of turn.

    The only way for a plan that flashes: --armed-by says who at the stage answers for it.
    """
    started = service.post(f"/queue/{in_url(args.entry)}/start", {"armed_by": args.armed_by})
    output.result(started, f"capture {started['capture']} runs")


def run_hold(_args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Begin nothing by itself any more.

    A start of the service, a blackout, an abort, a capture that does not complete and a jump of the
    clock do the same.
    """
    _show(service.post("/queue:hold"), output)


def run_go_on(_args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Begin what waits again; prints why the queue was held.

    Where something happens meanwhile the queue stays held: read why, and say it again.
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
        lines.append(f"waits for: {queue['waits_for']}")
    output.result(queue, "\n".join(lines) or "nothing waits")
