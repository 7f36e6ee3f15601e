"""`capture`, `lease` and `jobs`: a running service, from the command line."""

from __future__ import annotations

import argparse
import getpass
import json
import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stage_service.cli.output import (
    BAD_INPUT,
    FAILED,
    CommandError,
    Commands,
    Output,
    add_command,
    add_group,
    progress_bar,
)

if TYPE_CHECKING:
    from stage_service.cli.client import Service

RemoteRun = Callable[[argparse.Namespace, Output, "Service"], int]


def add(commands: Commands) -> None:
    """Add the commands."""
    capture = add_group(commands, "capture", "make and steer captures on a running service")
    check = _remote(capture, "check", run_check, "cost a plan without lighting a lamp")
    start = _remote(capture, "start", run_start, "begin a capture")
    check.add_argument("--rig", type=Path, help="ask this rig file, not a service")
    for parser in (check, start):
        parser.add_argument("--plan", type=Path, help="plan as JSON; without it, everything")
    start.add_argument("--head", type=Path, help="the digitised head (.obj)")
    start.add_argument("--masks", type=Path, help="folder of hair masks, <camera>.png")
    _pipeline(start.add_argument("--pipeline", help="job to enqueue when the capture completes"))
    start.add_argument("--options", help="the pipeline's options: JSON or a JSON file")
    start.add_argument("--armed-by", help="who answers for flashes that the plan has consent for")
    start.add_argument("--wait", action="store_true", help="wait for capture and job, steer alone")
    _remote(capture, "list", run_list_captures, "list captures, oldest first")
    for action, what in (
        ("show", "show where a capture is"),
        ("pause", "pause at the next step"),
        ("resume", "go on after a pause; shoot what an aborted or failed capture lacks"),
        ("abort", "abort at the next step, lights off"),
    ):
        parser = _remote(capture, action, run_capture_action, what)
        parser.add_argument("capture", help="its id")
        if action == "resume":
            parser.add_argument("--armed-by", help="as for start")

    lease = add_group(commands, "lease", "steer a stage alone for some time")
    take = _remote(lease, "take", run_take_lease, "take the lease; prints its token")
    take.add_argument("--holder", help="in whose name; without it, this user and machine")
    take.add_argument("--seconds", type=float, default=600.0)
    _remote(lease, "show", run_show_lease, "show who steers, and until when")
    renew = _remote(lease, "renew", run_renew_lease, "let the lease of --lease end later")
    renew.add_argument("--seconds", type=float, default=600.0, help="from now")
    _remote(lease, "release", run_release_lease, "end the lease of --lease")

    jobs = add_group(commands, "jobs", "submit, follow and cancel jobs on a running service")
    submit = _remote(jobs, "submit", run_submit, "enqueue a pipeline on a finished capture")
    submit.add_argument("capture", help="the capture's id")
    _pipeline(submit.add_argument("--pipeline", default="light_planes"))
    submit.add_argument("--options", help="the pipeline's options: JSON or a JSON file")
    submit.add_argument("--model", help="name of the model folder; without it, a new one")
    submit.add_argument("--wait", action="store_true", help="wait until the job is done")
    _remote(jobs, "list", run_list_jobs, "list jobs, newest first")
    for action, what in (
        ("show", "show where a job is"),
        ("wait", "wait until a job is done"),
        ("cancel", "cancel a job"),
        ("report", "print a job's report"),
        ("artifacts", "list the files of a job's model"),
    ):
        _remote(jobs, action, run_job_action, what).add_argument("job", help="its id")


def run_check(args: argparse.Namespace, output: Output, service: Service) -> int:
    """Cost a plan; with a rig file, without a service or a device."""
    if args.rig is not None:
        from pydantic import ValidationError

        from stage_service.config import load_rig_file
        from stage_service.plan.capture_plan import CapturePlan
        from stage_service.plan.resolved import resolve

        try:
            plan = CapturePlan.model_validate(_read_json(args.plan))
        except ValidationError as error:
            problems = "; ".join(
                f"{'.'.join(map(str, e['loc']))}: {e['msg']}, got {e['input']!r}"
                for e in error.errors()
            )
            raise CommandError(f"{args.plan}: {problems}", BAD_INPUT) from error
        cost = resolve(plan, load_rig_file(args.rig)).cost.model_dump(mode="json")
    else:
        cost = service.post("/plans:validate", _read_json(args.plan))
    output.result(cost, _costed(cost))
    return 0


def _costed(cost: dict[str, Any]) -> str:
    """A plan's cost, for people."""
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
        + (": needs consent, or rate_hz; see docs/safety.md" if flash["needs_consent"] else ""),
        f"light: {cost['lamp_seconds']:.1f} lamp seconds, "
        f"{', '.join(f'{d:.3g}' for d in cost['dose'])} J/m² (R, G, B) at the head",
    ]
    lines += [f"left out: {x['what']}: {x['why']}" for x in cost["left_out"]]
    return "\n".join(lines)


def run_start(args: argparse.Namespace, output: Output, service: Service) -> int:
    """Begin a capture, and wait for it where asked."""
    body: dict[str, Any] = {"plan": _read_json(args.plan)}
    for field in ("head", "masks"):
        if getattr(args, field) is not None:
            body[field] = str(getattr(args, field).resolve())
    if args.pipeline is not None:
        body["pipeline"] = {"name": args.pipeline, "options": _options(args.options)}
    if args.armed_by is not None:
        body["armed_by"] = args.armed_by
    if not args.wait:
        capture = service.post("/captures", body)
        output.result(capture, f"capture {capture['id']} runs")
        return 0
    with service.leased(_me()) as renew, progress_bar("capture") as progress:
        capture = service.post("/captures", body)
        capture = service.follow_capture(capture["id"], progress, renew)
    if capture["outcome"] != "completed":
        output.result({"capture": capture}, f"{capture['outcome']}: {capture['error'] or ''}")
        return FAILED
    if capture["job"] is None:
        output.result({"capture": capture}, f"capture {capture['id']}: {capture['path']}")
        return 0
    return _wait(service, capture["job"], output, {"capture": capture})


def run_list_captures(args: argparse.Namespace, output: Output, service: Service) -> int:
    """List captures."""
    captures = service.get("/captures")
    lines = [
        f"{c['id']}  {c['outcome'] or c['state']}  {c['frames_written']}/{c['frames_planned']} "
        f"frames  {c['path']}"
        for c in captures
    ]
    output.result({"captures": captures}, "\n".join(lines) or "no captures")
    return 0


def run_capture_action(args: argparse.Namespace, output: Output, service: Service) -> int:
    """Show, pause, resume or abort."""
    path = f"/captures/{args.capture}"
    if args.action == "show":
        output.result(service.get(path))
        return 0
    body = {"armed_by": args.armed_by} if args.action == "resume" else None
    output.result(service.post(f"{path}/{args.action}", body))
    return 0


def run_take_lease(args: argparse.Namespace, output: Output, service: Service) -> int:
    """Take the lease."""
    granted = service.post("/lease", {"holder": args.holder or _me(), "seconds": args.seconds})
    output.result(granted, granted["token"])
    return 0


def run_show_lease(_args: argparse.Namespace, output: Output, service: Service) -> int:
    """Show who steers."""
    held = service.get("/lease")
    text = f"{held['holder']} until {held['expires']}" if held["holder"] else "nobody: anybody may"
    output.result(held, text)
    return 0


def run_renew_lease(args: argparse.Namespace, output: Output, service: Service) -> int:
    """Renew the lease."""
    granted = service.ask("PATCH", "/lease", json={"seconds": args.seconds})
    output.result(granted, f"until {granted['expires']}")
    return 0


def run_release_lease(_args: argparse.Namespace, output: Output, service: Service) -> int:
    """End the lease."""
    output.result(service.ask("DELETE", "/lease"), "released")
    return 0


def run_submit(args: argparse.Namespace, output: Output, service: Service) -> int:
    """Enqueue a job."""
    body = {
        "capture": args.capture,
        "pipeline": {"name": args.pipeline, "options": _options(args.options)},
        "model": args.model,
    }
    job = service.post("/jobs", body)
    if args.wait:
        return _wait(service, job["id"], output, {})
    output.result(job, f"job {job['id']} is {job['state']}")
    return 0


def run_list_jobs(args: argparse.Namespace, output: Output, service: Service) -> int:
    """List jobs."""
    jobs = service.get("/jobs")
    lines = [f"{j['id']}  {j['pipeline']}  {j['outcome'] or j['state']}" for j in jobs]
    output.result({"jobs": jobs}, "\n".join(lines) or "no jobs")
    return 0


def run_job_action(args: argparse.Namespace, output: Output, service: Service) -> int:
    """Show, wait for, cancel, or read what a job left."""
    path = f"/jobs/{args.job}"
    if args.action == "wait":
        return _wait(service, args.job, output, {})
    if args.action == "artifacts":
        files = service.get(f"{path}/artifacts")
        lines = "\n".join(f"{f['bytes']:>12}  {f['path']}" for f in files)
        output.result({"artifacts": files}, lines or "no files yet")
    elif args.action == "report":
        output.result(service.get(f"{path}/report"))
    else:
        output.result(service.ask("DELETE" if args.action == "cancel" else "GET", path))
    return 0


def _wait(service: Service, job: str, output: Output, more: dict[str, Any]) -> int:
    with progress_bar("job") as progress:
        done = service.follow_job(job, progress)
    why = f": {done['error']['detail']}" if done["error"] else ""
    output.result({**more, "job": done}, f"{job} {done['outcome']}{why}; model: {done['model']}")
    return 0 if done["outcome"] == "succeeded" else FAILED


def _remote(group: Commands, name: str, run: RemoteRun, help: str) -> argparse.ArgumentParser:
    def connected(args: argparse.Namespace, output: Output) -> int:
        from stage_service.cli.client import Service

        with Service(args.url, args.lease) as service:
            return run(args, output, service)

    parser = add_command(group, name, connected, help)
    parser.add_argument("--url", help="the service's URL (also: HAIRSTAGE_URL)")
    parser.add_argument("--lease", help="token of the lease under which to steer")
    return parser


def _me() -> str:
    try:
        user = getpass.getuser()
    except (OSError, KeyError):  # a container's user may have no name
        user = f"user {os.getuid()}"
    return f"{user} on {socket.gethostname()}"


def _pipeline(action: argparse.Action) -> None:
    from stage_service.jobs.pipelines import PIPELINES

    action.choices = sorted(PIPELINES)


def _read_json(path: Path | None) -> Any:
    if path is None:
        return {}
    try:
        return json.loads(path.read_text())
    except json.JSONDecodeError as error:
        raise CommandError(f"{path} is not JSON: {error}", BAD_INPUT, "BadInput") from error


def _options(text: str | None) -> Any:
    if text is None:
        return {}
    if not text.lstrip().startswith("{"):
        return _read_json(Path(text))
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise CommandError(f"--options is not JSON: {error}", BAD_INPUT, "BadInput") from error
