"""`hairstage simulate`: a stage that exists only here."""

from __future__ import annotations

import argparse
import signal
import time
from pathlib import Path

from stage_service.cli.support import Commands, Output, add_command
from stage_service.cli.support.processes import add_subject, exit_on_sigterm


def add(commands: Commands) -> None:
    """Add the command."""
    simulate = add_command(
        commands,
        "simulate",
        run_simulate,
        "run a simulated rig behind the same wires as a real one",
        "Run the device side of every wire. STATE/devices.toml is written when they answer: give "
        "it to 'hairstage serve --devices'. To calibrate, SUBJECT is board:N, mirror:N or "
        "diffuse:N, in pose or place N.",
    )
    add_subject(simulate)
    simulate.add_argument("--state", type=Path, default=Path("runs/simulated"), help="state folder")
    simulate.add_argument("--truth", type=Path, help="write the true strands and appearance here")
    simulate.add_argument("--faults", type=Path, help="faults to inject")
    simulate.add_argument(
        "--ports", choices=("auto", "rig"), default="auto", help="free TCP ports, or the rig file's"
    )


def run_simulate(args: argparse.Namespace, output: Output) -> int:
    """Spawn the simulators and stay until they end."""
    from stage_service.cli.support.children import Children, SimulatedRig

    exit_on_sigterm()
    more = ["--state", args.state, "--ports", args.ports]
    for option in ("truth", "faults"):
        if getattr(args, option) is not None:
            more += [f"--{option}", getattr(args, option)]
    simulated = SimulatedRig(args.rig, args.subject, args.head, args.seed)
    with Children(args.state / "logs") as children:
        child = children.start("simulators", simulated.command(*more), to_log=False, answers=True)
        devices = children.first_line("simulators", child, 600)["devices"]
        output.result({"devices": devices}, f"the simulated rig answers; see {devices}")
        while (code := child.poll()) is None:  # a signal may come just before a sleep: a short one
            time.sleep(0.2)
        return 0 if code in (0, -signal.SIGINT, -signal.SIGTERM) else 1
