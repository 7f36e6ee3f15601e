"""`hairstage demo`: one capture and one job on a simulated rig, in three processes."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stage_service.cli.stage.processes import SUBJECTS, add_subject, exit_on_sigterm
from stage_service.cli.support.commands import (
    FAILED,
    BadArgument,
    CommandError,
    Commands,
    Output,
    add_command,
    progress_bar,
)

if TYPE_CHECKING:
    from reconstruction import Rig
    from stage_service.cli.support.children import Children
    from stage_service.cli.support.client import ServiceClient

MARK = ".hairstage-demo"
EVERY_NTH_LIGHT = 28
"""One light of so many is held out: a dozen of 331. Of few lights, four are."""

TURNING_FRAMES = 36
"""Frames of the animation at the end."""

READY_S = 300.0
"""Deadline for a process of the demo to become ready."""


def add(commands: Commands) -> None:
    """Add the command."""
    demo = add_command(commands, "demo", run_demo)
    add_subject(demo)
    demo.add_argument("--out", type=Path, default=Path("runs/demo"), help="output folder")
    demo.add_argument("--environment", default="studio", help="studio, sky, .hdr or .exr file")
    demo.add_argument("--hold-out-camera", metavar="CAMERA", help="default: the rig's last camera")


def run_demo(args: argparse.Namespace, output: Output) -> None:
    """Capture, reconstruct, fit and relight a simulated subject.

    Start a simulated rig, the service and a worker; make one capture through the REST API and
    follow its job, which scores the result against the truth. Results go to OUT; those of an
    earlier demo there are replaced.
    """
    from reconstruction import Model, Rig
    from reconstruction.array_backend import chosen_variant
    from stage_service.cli.demo_screen import last_screen
    from stage_service.cli.support.children import Children
    from stage_service.cli.support.client import ServiceClient

    exit_on_sigterm()
    begin = time.perf_counter()
    out: Path = args.out
    os.environ.setdefault("HAIRSTAGE_TOKEN_FILE", str((out / "token").resolve()))
    rig = Rig.load(args.rig)
    held_out = hold_out(rig, args.hold_out_camera)
    chosen_variant()  # fail before a process is started
    _check(args)
    _prepare(out)

    with Children(out / "logs") as children:
        output.note(
            f"starting simulated rig, service and worker; their logs: {out.resolve() / 'logs'}"
        )
        with ServiceClient(_start(children, args)) as service:
            capture = _capture(children, service, args, held_out, output)
            job = _job(children, service, capture["job"], out)

    model = Model(out / "model")
    results = {
        "seconds": time.perf_counter() - begin,
        "subject": args.subject,
        "seed": args.seed,
        "rig": rig.name,
        "held_out": held_out,
        "capture": {
            key: capture[key]
            for key in ("id", "seconds", "frames_planned", "frames_written", "frames_missing")
        },
        "job": job["id"],
        **model.json("results.json"),
    }
    (out / "results.json").write_text(json.dumps(results, indent=1, allow_nan=False) + "\n")
    output.result(results, last_screen(results, out))


def _capture(
    children: Children,
    service: ServiceClient,
    args: argparse.Namespace,
    held_out: dict[str, list[str]],
    output: Output,
) -> dict[str, Any]:
    """Make the capture, whose completion enqueues the job."""
    cost = service.post("/plans:validate", {})
    output.note(
        f"the capture takes {cost['frames']} frames, {cost['bytes'] / 1e9:.1f} GB and, on real "
        f"devices, {cost['seconds']:.0f} s; the simulated rig renders each frame"
    )
    truth = (args.out / "truth").resolve()
    options = {
        **held_out,
        "environment": args.environment,
        "seed": args.seed,
        "truth": str(truth),
        "assess": {"turning_frames": TURNING_FRAMES},
    }
    body: dict[str, Any] = {"plan": {}, "pipeline": {"name": "full", "options": options}}
    if (truth / "head.obj").is_file():
        body["head"] = str(truth / "head.obj")
    capture = service.post("/captures", body)
    with progress_bar("capture") as progress:
        capture = service.follow_capture(capture["id"], progress, children.check)
    _link(args.out / "capture", Path(capture["path"]))
    if capture["outcome"] != "completed":
        raise CommandError(f"the capture {capture['outcome']}: {capture['error']}", FAILED)
    return capture


def _job(children: Children, service: ServiceClient, job_id: str, out: Path) -> dict[str, Any]:
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
    """Start the three processes; returns the service's URL when all are ready."""
    from stage_service.cli.support.children import SimulatedRig, own_command

    out: Path = args.out
    simulated = SimulatedRig(args.rig, args.subject, args.head, args.seed).command(
        *("--state", out / "simulated", "--truth", out / "truth", "--ports", "auto")
    )
    devices = children.ready("simulators", simulated, READY_S)["devices"]
    serve = own_command(
        *("serve", "--json", "--rig", args.rig, "--devices", devices),
        *("--root", out, "--port", "0"),
    )
    # The latest ends first: the service, so that its lamps do not wait for the worker.
    worker = children.start("worker", own_command("worker", "--json", "--root", out), pipe=True)
    service = children.start("service", serve, pipe=True)
    url: str = children.first_line("service", service, READY_S)["url"]
    children.first_line("worker", worker, READY_S)
    return url


def hold_out(rig: Rig, camera: str | None = None) -> dict[str, list[str]]:
    """The job's options that hold out `camera` (default: the rig's last) and a dozen lights."""
    name = rig.cameras[-1].name if camera is None else rig.camera(camera).name
    every = min(EVERY_NTH_LIGHT, max(len(rig.lights) // 4, 1))
    lights = [light.name for light in rig.lights[every // 2 :: every]]
    return {"held_out_cameras": [name], "held_out_lights": lights}


def _check(args: argparse.Namespace) -> None:
    """Check the arguments before an earlier demo is removed; make their paths absolute."""
    from appearance.render.environment_maps import PROCEDURAL, environment_map
    from reconstruction import read_obj, read_strands

    if args.seed < 0:
        raise BadArgument(f"--seed {args.seed}: expected 0 or more")
    environment_map(args.environment)
    if args.environment not in PROCEDURAL:
        args.environment = str(Path(args.environment).resolve())
    if args.subject in SUBJECTS:
        if args.head is not None:
            raise BadArgument(f"--head: the subject {args.subject} brings its own")
        return
    if not Path(args.subject).is_file():
        names = ", ".join(SUBJECTS)
        raise BadArgument(f"--subject {args.subject}: expected a strand file or one of {names}")
    read_strands(args.subject)
    if args.head is not None:
        read_obj(args.head)
    args.subject = str(Path(args.subject).resolve())


def _prepare(out: Path) -> None:
    """Make `out` an empty folder, if it is new or an earlier demo's."""
    if out.is_dir() and any(out.iterdir()):
        if not (out / MARK).is_file():
            raise BadArgument(
                f"{out} has files that no demo wrote: choose another folder with --out"
            )
        shutil.rmtree(out)
    out.mkdir(parents=True, exist_ok=True)
    (out / MARK).touch()


def _link(link: Path, target: Path) -> None:
    """Link OUT/NAME to the folder that the service chose."""
    link.symlink_to(target.resolve().relative_to(link.parent.resolve()))
