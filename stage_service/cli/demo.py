"""The demo's course: three processes, one capture, one job, one table."""

from __future__ import annotations

import argparse
import json
import shutil
import time
from pathlib import Path
from typing import Any

from reconstruction.geometry.rig import Rig
from stage_service.cli.children import Children, own_command, simulator_command
from stage_service.cli.client import Service
from stage_service.cli.demo_results import figures_table, gather
from stage_service.cli.output import BAD_INPUT, FAILED, CommandError, Output, progress_bar
from stage_service.cli.processes import exit_on_sigterm

MARK = ".hairstage-demo"
EVERY_NTH_LIGHT = 28
"""One of so many lights is held out: a dozen of 331. Of few lights, four are."""


def demo(args: argparse.Namespace, output: Output) -> int:
    """Run the whole product once; returns the exit code."""
    exit_on_sigterm()
    begin = time.perf_counter()
    out: Path = args.out
    rig = Rig.load(args.rig)
    held_out = _held_out(rig, args.hold_out_camera)
    for field in ("subject", "environment"):
        value = getattr(args, field)
        if "." in value or "/" in value:
            if not Path(value).is_file():
                raise CommandError(f"--{field}: there is no file {value}", BAD_INPUT, "BadInput")
            setattr(args, field, str(Path(value).resolve()))
    _prepare(out)

    with Children(out / "logs") as children:
        output.note(f"starting simulated rig, service and worker; their logs: {out / 'logs'}")
        with Service(_start(children, args)) as service:
            capture = _capture(children, service, args, held_out, output)
            job = _job(children, service, capture["job"], out)
        memory = children.peak_memory_gb()

    with progress_bar("evaluate") as progress:
        results = gather(out, capture, job, progress)
    results = {
        "seconds": time.perf_counter() - begin,
        "subject": args.subject,
        "rig": rig.name,
        "held_out": held_out,
        "peak_memory_gb": memory,
        **results,
    }
    (out / "results.json").write_text(json.dumps(results, indent=1, allow_nan=False) + "\n")
    output.result(results, figures_table(results, out))
    return 0


def _capture(
    children: Children,
    service: Service,
    args: argparse.Namespace,
    held_out: dict[str, list[str]],
    output: Output,
) -> dict[str, Any]:
    """Make the capture; its completion enqueues the job."""
    cost = service.post("/plans:validate", {})
    output.note(
        f"the capture takes {cost['frames']} frames, {cost['bytes'] / 1e9:.1f} GB and, on real "
        f"devices, {cost['seconds']:.0f} s; a simulated rig renders each frame"
    )
    options = {**held_out, "environment": args.environment, "seed": args.seed}
    body: dict[str, Any] = {"plan": {}, "pipeline": {"name": "light_planes", "options": options}}
    head: Path = args.out / "truth" / "head.obj"
    if head.is_file():
        body["head"] = str(head.resolve())
    capture = service.post("/captures", body)
    with progress_bar("capture") as progress:
        capture = service.follow_capture(capture["id"], progress, children.check)
    _link(args.out / "capture", Path(capture["path"]))
    if capture["outcome"] != "completed":
        raise CommandError(f"the capture {capture['outcome']}: {capture['error']}", FAILED)
    return capture


def _job(children: Children, service: Service, job_id: str, out: Path) -> dict[str, Any]:
    """Follow the job to its end."""
    with progress_bar("job") as progress:
        job = service.follow_job(job_id, progress, children.check)
    _link(out / "model", Path(job["model"]))
    if job["outcome"] != "succeeded":
        step = job["progress"]["step"] if job["progress"] else "first"
        why = job["error"]["detail"] if job["error"] else job["outcome"]
        raise CommandError(
            f"the job failed in its {step} step: {why}; its log is {children.log('worker')}", FAILED
        )
    return job


def _start(children: Children, args: argparse.Namespace) -> str:
    """Start the three processes as a user would; returns the URL when all are ready."""
    out: Path = args.out
    state = out / "simulated"
    simulators = children.start(
        "simulators",
        simulator_command(args, state, out / "truth", "--ports", "auto"),
        answers=True,
    )
    devices = children.first_line("simulators", simulators, 300)["devices"]
    serve = own_command(
        *("serve", "--json", "--rig", args.rig, "--devices", devices),
        *("--root", out, "--port", "0"),
    )
    # Ended the latest first: the service, whose lamps must not wait for the worker.
    worker = children.start("worker", own_command("worker", "--json", "--root", out), answers=True)
    service = children.start("service", serve, answers=True)
    url: str = children.first_line("service", service, 60)["url"]
    children.first_line("worker", worker, 60)
    return url


def _held_out(rig: Rig, camera: str | None) -> dict[str, list[str]]:
    name = rig.cameras[-1].name if camera is None else rig.camera(camera).name
    every = min(EVERY_NTH_LIGHT, max(len(rig.lights) // 4, 1))
    lights = [light.name for light in rig.lights[every // 2 :: every]]
    return {"held_out_cameras": [name], "held_out_lights": lights}


def _prepare(out: Path) -> None:
    """Make `out` an empty folder; what an earlier demo left there goes, anything else stays."""
    if out.is_dir() and any(out.iterdir()):
        if not (out / MARK).is_file():
            raise CommandError(
                f"{out} holds something that no demo wrote: choose another folder with --out",
                BAD_INPUT,
                "BadInput",
            )
        shutil.rmtree(out)
    out.mkdir(parents=True, exist_ok=True)
    (out / MARK).touch()


def _link(link: Path, target: Path) -> None:
    """A name in OUT for the folder that the service chose."""
    link.symlink_to(target.resolve().relative_to(link.parent.resolve()))
