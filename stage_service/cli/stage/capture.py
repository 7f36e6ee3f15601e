"""`hairstage capture`: captures on a running service."""

from __future__ import annotations

import argparse
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stage_service.cli.stage.jobs import add_pipeline, wait_for_job
from stage_service.cli.support.commands import (
    FAILED,
    BadArgument,
    Commands,
    Output,
    add_group,
    in_url,
    progress_bar,
    read_json,
    rig_path,
)
from stage_service.cli.support.remote import add_remote
from stage_service.signals import Terminated, held

if TYPE_CHECKING:
    from stage_service.cli.support.client import ServiceClient


PLAN = "plan as JSON; default: all lights and projectors"


def add(commands: Commands) -> None:
    """Add the commands."""
    capture = add_group(commands, "capture", "make and steer captures on a running service")
    check = add_remote(capture, "check", run_check)
    start = add_remote(capture, "start", run_start)
    check.add_argument(
        "--rig", type=rig_path, help="check against this rig file instead of a service"
    )
    _add_plan(check)
    add_requested(start)
    start.add_argument(
        "--armed-by",
        help="who at the stage is responsible for flashes that the plan has consent for",
    )
    start.add_argument(
        "--wait", action="store_true", help="hold the lease, and wait for the capture and its job"
    )
    add_remote(capture, "list", run_list_captures)
    for action, what in (
        ("show", "show a capture's state"),
        ("pause", "pause at the next step"),
        (
            "resume",
            "resume after a pause; shoot the frames that an aborted or failed capture lacks",
        ),
        ("abort", "abort at the next step, lights off"),
    ):
        parser = add_remote(capture, action, run_capture_action, what)
        parser.add_argument("capture", help="its id")
        if action == "resume":
            parser.add_argument("--armed-by", help="as for start")


def _add_plan(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--plan", type=Path, help=PLAN)
    parser.add_argument(
        "--patterns",
        metavar="KIND_OR_TABLE",
        help="patterns of lights, not single ones: s_matrix, gradients, or a table (.csv, .json)",
    )


def _plan_of(args: argparse.Namespace) -> dict[str, Any]:
    """The plan of `_add_plan`'s options."""
    from reconstruction.capture.light_patterns import PatternError, read_table

    plan = read_json(args.plan)
    if args.patterns in ("s_matrix", "gradients"):
        return plan | {"patterns": args.patterns}
    if args.patterns is None:
        return plan
    try:
        rows = read_table(Path(args.patterns)).items()
    except PatternError as error:
        also = "give s_matrix, gradients, or a table (.csv, .json)"
        raise BadArgument(f"--patterns: {error}: {also}") from error
    # what is off is left out: a request has few values
    return plan | {"patterns": {n: {x: w for x, w in row.items() if w} for n, row in rows}}


def add_requested(parser: argparse.ArgumentParser) -> None:
    """Add the options of a capture: plan, head, masks, pipeline."""
    _add_plan(parser)
    parser.add_argument("--head", type=Path, help="the digitised head (.obj)")
    parser.add_argument("--masks", type=Path, help="folder of hair masks, <camera>.png")
    parser.add_argument("--upload", help="name of a subject whose head and masks were uploaded")
    add_pipeline(parser, None, "job to enqueue when the capture completes")


def requested(args: argparse.Namespace) -> dict[str, Any]:
    """The request body made of `add_requested`'s options."""
    body: dict[str, Any] = {"plan": _plan_of(args)}
    for field in ("head", "masks"):
        if getattr(args, field) is not None:
            body[field] = str(getattr(args, field).resolve())
    if args.upload is not None:
        body["upload"] = args.upload
    if args.options is not None and args.pipeline is None:
        raise BadArgument("--options are those of a pipeline: name it with --pipeline")
    if args.pipeline is not None:
        body["pipeline"] = {"name": args.pipeline, "options": read_json(args.options)}
    return body


def run_check(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Cost a plan; lights no lamp."""
    if args.rig is not None:
        from reconstruction import parse_options
        from stage_service.config import load_rig_file
        from stage_service.plan.capture_plan import CapturePlan
        from stage_service.plan.resolved import resolve

        plan = parse_options(CapturePlan, _plan_of(args), f"{args.plan}: plan")
        cost = resolve(plan, load_rig_file(args.rig)).cost.model_dump(mode="json")
    else:
        cost = service.post("/plans:validate", _plan_of(args))
    output.result(cost, _costed(cost))


def _costed(cost: dict[str, Any]) -> str:
    """A plan's cost as text."""
    flash = cost["flash"]
    kinds = ", ".join(f"{n} {kind}" for kind, n in cost["frames_by_kind"].items())
    causes = ", ".join(f"{c} {s:.1f}" for c, s in cost["seconds_by_cause"].items() if s)
    lines = [
        f"{cost['steps']} steps, {cost['frames']} frames ({kinds}), {cost['bytes'] / 1e9:.1f} GB",
        f"{cost['seconds']:.1f} s: {causes}; limited by {cost['limited_by']}",
        cost["stepping_why"]
        if cost["stepping"]["hardware"]
        else f"the service clocks every step: {cost['stepping_why']}",
        f"flashes at {flash['hz']:.1f} Hz ({flash['band']})"
        + (
            ": needs consent, or rate_hz; see docs/how-to/safety.md"
            if flash["needs_consent"]
            else ""
        ),
        f"light: {cost['lamp_seconds']:.1f} lamp seconds, "
        f"{', '.join(f'{d:.3g}' for d in cost['dose'])} J/m² (R, G, B) at the head",
    ]
    lines += [f"skipped: {x['what']}: {x['why']}" for x in cost["left_out"]]
    return "\n".join(lines)


def run_start(args: argparse.Namespace, output: Output, service: ServiceClient) -> int:
    """Begin a capture."""
    body = requested(args)
    if args.armed_by is not None:
        body["armed_by"] = args.armed_by
    capture: dict[str, Any] = {}
    if not args.wait:
        capture = service.post("/captures", body)
        output.result(capture, f"capture {capture['id']} runs")
        return 0
    with service.leased() as renew, progress_bar("capture") as progress:
        try:
            with held(signal.SIGINT, signal.SIGTERM):  # until its id is known
                capture = service.post("/captures", body)
            capture = service.follow_capture(capture["id"], progress, renew)
        except (KeyboardInterrupt, Terminated) as stop:
            if not capture:
                raise
            service.post(f"/captures/{capture['id']}/abort")
            capture = service.follow_capture(capture["id"], progress)
            remains = f"capture {capture['id']} {capture['outcome']}; 'hairstage capture resume "
            raise type(stop)(f"{remains}{capture['id']}' shoots the rest") from None
    if capture["outcome"] != "completed":
        output.result({"capture": capture}, f"{capture['outcome']}: {capture['error'] or ''}")
        return FAILED
    if capture["job"] is None:
        output.result({"capture": capture}, f"capture {capture['id']}: {capture['path']}")
        return 0
    return wait_for_job(service, capture["job"], output, {"capture": capture})


def run_list_captures(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """List captures, oldest first."""
    captures = [c for page in reversed(service.all("/captures")) for c in page]
    lines = [
        f"{c['id']}  {c['outcome'] or c['state']}  {c['frames_written']}/{c['frames_planned']} "
        f"frames  {c['path']}"
        for c in captures
    ]
    output.result({"captures": captures}, "\n".join(lines) or "no captures")
    if unread := service.get("/health")["unread"]:
        output.note(
            f"{unread:,} captures are not listed: the service has just started and is reading them"
        )


def run_capture_action(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Show, pause, resume or abort."""
    path = f"/captures/{in_url(args.capture)}"
    if args.action == "show":
        output.result(service.get(path))
        return
    body = {"armed_by": args.armed_by} if args.action == "resume" else None
    output.result(service.post(f"{path}/{args.action}", body))
