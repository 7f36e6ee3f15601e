"""`hairstage demo`: one capture and one job on a simulated rig, in three processes."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stage_service.cli.demo_kinds import FULL, QUICK, DemoKind, quick_rig
from stage_service.cli.stage.processes import SUBJECTS, add_subject
from stage_service.cli.support.commands import (
    FAILED,
    BadArgument,
    CommandError,
    Commands,
    Output,
    add_command,
    in_url,
    progress_bar,
)

if TYPE_CHECKING:
    from reconstruction import Rig
    from stage_service.cli.demo_progress import DemoProgress
    from stage_service.cli.support.children import Children
    from stage_service.cli.support.client import ServiceClient

MARK = ".hairstage-demo"
EVERY_NTH_LIGHT = 28
"""One light of so many is held out: a dozen of 331. Of few lights, four are."""

NAMED = {
    "reconstruct": ("strands", "strands.npz", ""),
    "relight": ("result", "index.html", "; held-out frames, baselines and the truth follow"),
}
"""By step of the job: its result, the file that shows it, and what comes next."""

READY_S = 300.0
"""Deadline for a process of the demo to become ready."""


def add(commands: Commands) -> None:
    """Add the command."""
    remains = "lamps and processes are off; the next demo in the same folder begins anew"
    demo = add_command(commands, "demo", run_demo, interrupted=remains, renders=True)
    add_subject(demo)
    demo.add_argument("--out", type=Path, default=Path("runs/demo"), help="output folder")
    demo.add_argument("--environment", default="studio", help="studio, sky, .hdr or .exr file")
    demo.add_argument("--hold-out-camera", metavar="CAMERA", help="default: the rig's last camera")
    demo.add_argument("--quick", action="store_true", help="fewer lights, pixels and samples")


def run_demo(args: argparse.Namespace, output: Output) -> None:
    """Capture, reconstruct, fit and relight a simulated subject.

    Start a simulated rig, the service and a worker; make one capture through the REST API and
    follow its job, which scores the result against the truth. Results go to OUT; those of an
    earlier demo there are replaced.
    """
    from reconstruction import Model, Rig
    from reconstruction.array_backend import chosen_variant
    from stage_service.cli.demo_progress import DemoProgress
    from stage_service.cli.demo_screen import last_screen
    from stage_service.cli.support.children import Children
    from stage_service.cli.support.client import ServiceClient

    begin = time.perf_counter()
    out: Path = args.out
    os.environ.setdefault("HAIRSTAGE_TOKEN_FILE", str((out / "token").resolve()))
    hold_out(Rig.load(args.rig), args.hold_out_camera)
    chosen_variant()  # fail before a process is started
    _check(args)
    kind, quick = (QUICK, quick_rig(args.rig)) if args.quick else (FULL, None)
    _prepare(out)
    if quick is not None:
        output.note(kind.label)
        args.rig = out / "rig.json"
        args.rig.write_text(json.dumps(quick, indent=1))
    rig = Rig.load(args.rig)
    held_out = hold_out(rig, args.hold_out_camera)

    with Children(out / "logs") as children, ExitStack() as stack:
        output.note(
            f"starting simulated rig, service and worker; their logs: {out.resolve() / 'logs'}"
        )
        with progress_bar("demo") as show:
            progress = DemoProgress(show, kind.capture_s, kind.steps_s)
            service = stack.enter_context(ServiceClient(_start(children, args, kind)))
            capture = _capture(children, service, args, kind, held_out, progress, output)
            job = _job(children, service, capture["job"], kind, progress, out, output)
        progress.save(out / "logs" / "progress.csv")
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
            **Model(out / "model").json("results.json"),
        }
        (out / "results.json").write_text(json.dumps(results, indent=1, allow_nan=False) + "\n")
        screen = last_screen(results, out)
        if not output.as_json:
            output.result(results, screen)
        with progress_bar("demo") as show:  # nobody waits for the rest
            _check_job(service.follow_job(job["id"], show, children.check), children)
    if output.as_json:
        output.result(results, screen)


def _capture(
    children: Children,
    service: ServiceClient,
    args: argparse.Namespace,
    kind: DemoKind,
    held_out: dict[str, list[str]],
    progress: DemoProgress,
    output: Output,
) -> dict[str, Any]:
    """Make the capture, whose completion enqueues the job."""
    cost = service.post("/plans:validate", {})
    output.note(
        f"the capture takes {cost['frames']} frames, {cost['bytes'] / 1e9:.1f} GB and, on real "
        f"devices, {cost['seconds']:.0f} s; the simulated rig renders them"
    )
    truth = (args.out / "truth").resolve()
    options = {
        **held_out,
        "environment": args.environment,
        "seed": args.seed,
        "truth": str(truth),
        **kind.job_options,
    }
    body: dict[str, Any] = {"plan": {}, "pipeline": {"name": kind.pipeline, "options": options}}
    if (truth / "head.obj").is_file():
        body["head"] = str(truth / "head.obj")
    capture = service.post("/captures", body)
    capture = service.follow(f"/captures/{capture['id']}", progress.capture, children.check)
    _link(args.out / "capture", Path(capture["path"]))
    if capture["outcome"] != "completed":
        raise CommandError(f"the capture {capture['outcome']}: {capture['error']}", FAILED)
    return capture


def _job(
    children: Children,
    service: ServiceClient,
    job_id: str,
    kind: DemoKind,
    progress: DemoProgress,
    out: Path,
    output: Output,
) -> dict[str, Any]:
    """Follow the job until its results are written; names each as soon as it is there."""
    steps = list(kind.steps_s)
    named: set[str] = set()

    def show(job: dict[str, Any]) -> None:
        if not (out / "model").is_symlink():
            _link(out / "model", Path(job["model"]))
        step = job["progress"]["step"] if job["progress"] else steps[0]
        for done in steps[: steps.index(step)] if step in steps else steps:
            if done in NAMED and done not in named:
                named.add(done)
                what, file, then = NAMED[done]
                output.note(f"{what}: {out.resolve() / 'model' / file}{then}")
        progress.job(job)

    def written(job: dict[str, Any]) -> bool:
        return job["progress"] is not None and job["progress"]["step"] not in steps

    job = service.follow(f"/jobs/{in_url(job_id)}", show, children.check, written)
    _check_job(job, children)
    return job


def _check_job(job: dict[str, Any], children: Children) -> None:
    """Raise `CommandError` for a job that has failed."""
    if job["outcome"] not in (None, "succeeded"):
        step = job["progress"]["step"] if job["progress"] else "first"
        why = job["error"]["detail"] if job["error"] else job["outcome"]
        raise CommandError(
            f"the job failed in its {step} step: {why}; its log is {children.log('worker')}", FAILED
        )


def _start(children: Children, args: argparse.Namespace, kind: DemoKind) -> str:
    """Start the three processes; returns the service's URL when all are ready."""
    from stage_service.cli.support.children import SimulatedRig, own_command

    out: Path = args.out
    simulated = SimulatedRig(args.rig, args.subject, args.head, args.seed).command(
        *("--state", out / "simulated", "--truth", out / "truth", "--ports", "auto"),
        *kind.simulator,
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
