"""`python -m simulators`: a simulated rig and subject behind the real wire protocols."""

from __future__ import annotations

import argparse
import functools
import json
import signal
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from appearance.scene.backend import BackendError, ensure_backend
from reconstruction.geometry.rig import RigError
from reconstruction.report.report import usable_cores
from simulators.frames.frames import FrameMaker, Sensor
from simulators.frames.render_process import RenderPool
from simulators.frames.responses import Quality, Responder, check_memory, reproducible
from simulators.frames.work import MeasuredResponder
from simulators.peers.devices import SimulatedStage
from simulators.peers.faults import Faults
from simulators.peers.lamps import Lamps
from simulators.subject.drift import Drift
from simulators.subject.props import Prop, PropResponder, named_prop
from simulators.subject.subject import NAMES, Subject, check_fits, load_subject
from simulators.subject.truth import EXPOSURES, write_truth
from simulators.world import World
from stage_service.config import RigFile, load_rig_file
from stage_service.signals import taken

_FAILED, _BAD_INPUT = 1, 2


def main(arguments: list[str] | None = None) -> int:
    """Run the simulated rig until SIGTERM or SIGINT; returns the exit code.

    When ready, it prints one line of JSON and `STATE/devices.toml` exists. Exit code 2: invalid
    argument or file; 1: the devices cannot start.
    """
    parser = _parser()
    args = parser.parse_args(arguments)
    if args.state is None and args.truth_only is None:
        parser.error("--state FOLDER is required (or --truth-only FOLDER)")
    for option, least in (("spp", 1), ("processes", 1), ("seed", 0)):
        if getattr(args, option) < least:
            parser.error(f"--{option} must be at least {least}, got {getattr(args, option)}")
    try:
        rig_file = load_rig_file(args.rig)
        cameras = [c.name for c in rig_file.rig.cameras]
        faults = Faults.load(args.faults, cameras) if args.faults else Faults()
        subject = named_prop(args.subject) or load_subject(args.subject, args.head, seed=args.seed)
        if isinstance(subject, Subject):
            check_fits(subject, rig_file.rig)
        drift = Drift(_poses(rig_file), args.drift_mm * 1e-3, args.seed)
        if args.truth_only is not None:
            write_truth(args.truth_only, subject, drift)
            return 0
        if isinstance(subject, Subject):
            check_memory(rig_file.rig, subject, args.processes)
        if args.truth is not None:
            write_truth(args.truth, subject, drift)
    except (ValueError, RigError, OSError) as error:
        print(f"simulators: {error}", file=sys.stderr)
        return _BAD_INPUT
    try:
        if isinstance(subject, Subject):
            ensure_backend()  # fail before the first frame of a capture
        _run(args, rig_file, subject, drift, faults)
    except (OSError, BackendError) as error:
        print(f"simulators: {error}", file=sys.stderr)
        return _FAILED
    return 0


def _run(
    args: argparse.Namespace,
    rig_file: RigFile,
    subject: Subject | Prop,
    drift: Drift,
    faults: Faults,
) -> None:
    rig, sensor, quality = rig_file.rig, Sensor(), Quality.scaled(args.spp)
    leave = taken(signal.SIGTERM, signal.SIGINT)
    with ExitStack() as stack:
        make: Callable[[], Responder]
        if isinstance(subject, Subject):
            make = functools.partial(reproducible, rig, subject, drift, quality, args.seed)
        else:
            make = functools.partial(PropResponder, rig, subject)
        names = [c.name for c in rig.cameras]
        responder = RenderPool(make, names, args.processes)
        poses = _poses(rig_file) if args.drift_mm > 0 else 1
        measured = MeasuredResponder(responder, rig, quality, args.processes, poses)
        frames = FrameMaker(rig, measured, sensor, args.seed)
        log = args.truth / EXPOSURES if args.truth is not None else None
        counts = frames.counts if args.drift_mm > 0 else frames.counts_at_rest
        lamps = Lamps(len(rig.lights))
        world = World(rig, lamps, faults, counts, log, args.processes, measured.busy)
        free = args.ports == "auto"
        wires, paced = rig_file.devices, args.paced
        stage = SimulatedStage(world, sensor, args.state, wires, free, paced)
        # the stack ends in reverse: the renderer first, so that no frame delays the devices' end
        stack.enter_context(stage)
        stack.callback(responder.stop)
        ready = {"ready": True, "devices": str(args.state / "devices.toml"), **stage.devices}
        print(json.dumps(ready), flush=True)
        leave()


def _poses(rig_file: RigFile) -> int:
    """Tracking frames of a sweep: one per full group of rows."""
    every = max(rig_file.capture.tracking_every, 1)
    return max(1, sum(max(1, p.height // every) for p in rig_file.rig.projectors))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m simulators",
        description="Simulated light stage: LED bank on the rig file's wire, trigger box and "
        "projector controller on pseudo-terminals, cameras on TCP. Frames are rendered from "
        "the devices' commanded states. Runs until SIGTERM.",
    )
    parser.add_argument("--rig", type=Path, required=True, help="rig file (TOML or JSON)")
    parser.add_argument(
        "--subject",
        default="wavy",
        help=f"{', '.join(NAMES)}, or a strand file; to calibrate: board:N, mirror:N or diffuse:N "
        "in pose or place N (default: wavy)",
    )
    parser.add_argument("--head", type=Path, help="OBJ of the head under the strand file's hair")
    parser.add_argument("--state", type=Path, help="folder for devices.toml and the serial ports")
    parser.add_argument("--seed", type=int, default=0, help="subject, drift and noise (default: 0)")
    parser.add_argument("--faults", type=Path, help="JSON list of faults (peers/faults.py)")
    parser.add_argument(
        "--ports", choices=("auto", "rig"), default="rig", help="free TCP ports, or the rig file's"
    )
    parser.add_argument(
        "--paced",
        action="store_true",
        help="delay responses of a light bank on RTU to its baud rate",
    )
    parser.add_argument("--truth", type=Path, help="folder for the true strands, head and poses")
    parser.add_argument("--truth-only", type=Path, help="write the truth to this folder and exit")
    parser.add_argument(
        "--spp", type=int, default=Quality.lights, help="paths per pixel (default: %(default)s)"
    )
    parser.add_argument(
        "--processes",
        type=int,
        default=min(usable_cores(), 4),
        help="rendering processes; frames do not depend on their number (default: %(default)s)",
    )
    parser.add_argument(
        "--drift-mm", type=float, default=1.5, help="drift of the subject (default: 1.5)"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
