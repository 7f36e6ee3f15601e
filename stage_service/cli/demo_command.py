"""`demo`: the whole product once, with a simulated rig."""

from __future__ import annotations

import argparse
from pathlib import Path

from stage_service.cli.output import Commands, Output, add_command


def add(commands: Commands) -> None:
    """Add the command."""
    demo = add_command(
        commands,
        "demo",
        run_demo,
        "capture, reconstruct, fit and relight a simulated subject",
        "Start a simulated rig, the service and a worker; make one capture through the REST API, "
        "follow its job, judge the result against the truth, and print the figures. Everything is "
        "left in OUT; an earlier demo's results there are replaced.",
    )
    demo.add_argument("--subject", default="wavy", help="wavy, straight, curly or a strand file")
    demo.add_argument("--head", type=Path, help="head mesh (.obj) for a strand file")
    demo.add_argument("--out", type=Path, default=Path("runs/demo"))
    demo.add_argument("--rig", type=Path, default=Path("deploy/rigs/demo.toml"))
    demo.add_argument("--environment", default="studio", help="studio, sky, .hdr or .exr file")
    demo.add_argument("--hold-out-camera", metavar="CAMERA", help="default: the rig's last camera")
    demo.add_argument("--seed", type=int, default=0)


def run_demo(args: argparse.Namespace, output: Output) -> int:
    """Run the demo."""
    from stage_service.cli.demo import demo

    return demo(args, output)
