"""`hairstage jobs`: jobs on a running service."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from stage_service.cli.support.commands import (
    FAILED,
    Commands,
    Output,
    add_group,
    in_url,
    progress_bar,
    read_json,
)
from stage_service.cli.support.remote import add_remote
from stage_service.signals import Terminated

if TYPE_CHECKING:
    from stage_service.cli.support.client import ServiceClient


def add(commands: Commands) -> None:
    """Add the commands."""
    jobs = add_group(commands, "jobs", "submit, follow and cancel jobs on a running service")
    submit = add_remote(jobs, "submit", run_submit)
    submit.add_argument("capture", help="the capture's id")
    add_pipeline(submit, "light_planes", "the steps to run")
    submit.add_argument("--model", help="name of the model folder; default: a new one")
    submit.add_argument("--wait", action="store_true", help="wait until the job is done")
    add_remote(jobs, "list", run_list_jobs)
    for action, what in (
        ("show", "show a job's state"),
        ("wait", "wait until a job is done"),
        ("cancel", "cancel a job"),
        ("report", "print a job's report"),
        ("artifacts", "list the files of a job's model"),
    ):
        add_remote(jobs, action, run_job_action, what).add_argument("job", help="its id")


def add_pipeline(parser: argparse.ArgumentParser, default: str | None, help: str) -> None:
    """Add `--pipeline` and `--options`."""
    from stage_service.jobs.pipelines import PIPELINES

    parser.add_argument("--pipeline", choices=sorted(PIPELINES), default=default, help=help)
    parser.add_argument("--options", help="the pipeline's options: JSON or a JSON file")


def run_submit(args: argparse.Namespace, output: Output, service: ServiceClient) -> int:
    """Enqueue a pipeline on a finished capture."""
    body = {
        "capture": args.capture,
        "pipeline": {"name": args.pipeline, "options": read_json(args.options)},
        "model": args.model,
    }
    job = service.post("/jobs", body)
    if args.wait:
        return wait_for_job(service, job["id"], output, {})
    output.result(job, f"job {job['id']} is {job['state']}")
    return 0


def run_list_jobs(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """List jobs, newest first."""
    jobs = [j for page in service.all("/jobs") for j in page]
    lines = [f"{j['id']}  {j['pipeline']}  {j['outcome'] or j['state']}" for j in jobs]
    output.result({"jobs": jobs}, "\n".join(lines) or "no jobs")


def run_job_action(args: argparse.Namespace, output: Output, service: ServiceClient) -> int:
    """Show, wait for or cancel a job, or print its report or files."""
    path = f"/jobs/{in_url(args.job)}"
    if args.action == "wait":
        return wait_for_job(service, args.job, output, {})
    if args.action == "artifacts":
        files = service.get(f"{path}/artifacts")
        lines = "\n".join(f"{f['bytes']:>12}  {f['path']}" for f in files)
        output.result({"artifacts": files}, lines or "no files yet")
    elif args.action == "report":
        output.result(service.get(f"{path}/report"))
    else:
        output.result(service.request("DELETE" if args.action == "cancel" else "GET", path))
    return 0


def wait_for_job(service: ServiceClient, job: str, output: Output, more: dict[str, Any]) -> int:
    """Follow a job to its end and print it together with `more`; returns the exit code."""
    try:
        with progress_bar("job") as progress:
            done = service.follow_job(job, progress)
    except (KeyboardInterrupt, Terminated) as stop:
        remains = f"job {job} continues: 'hairstage jobs wait' or 'cancel {job}'"
        raise type(stop)(remains) from None
    why = f": {done['error']['detail']}" if done["error"] else ""
    output.result({**more, "job": done}, f"{job} {done['outcome']}{why}; model: {done['model']}")
    return 0 if done["outcome"] == "succeeded" else FAILED
