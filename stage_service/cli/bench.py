"""`bench`: error against run time of our methods beside the plain ones."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stage_service.cli.output import (
    FAILED,
    CommandError,
    Commands,
    Output,
    add_command,
    progress_bar,
)


def add(commands: Commands) -> None:
    """Add the command."""
    bench = add_command(
        commands,
        "bench",
        run_bench,
        "measure error against run time",
        "olat: our renderer of many lights against Mitsuba's own path integrator, light by light. "
        "acquisition: steps and bytes a second beside what wires and disk allow. "
        "all: every one of them. Leaves OUT/<name>.json and OUT/<name>.png.",
    )
    bench.add_argument("name", choices=[*BENCHES, "all"])
    bench.add_argument("--out", type=Path, default=Path("runs/bench"))
    bench.add_argument("--subject", default="wavy", help="wavy, straight, curly or a strand file")
    bench.add_argument("--head", type=Path, help="head mesh (.obj) for a strand file")
    bench.add_argument("--rig", type=Path, default=Path("deploy/rigs/demo.toml"))
    bench.add_argument("--seed", type=int, default=0)


def run_bench(args: argparse.Namespace, output: Output) -> int:
    """Run one benchmark, or all."""
    names = list(BENCHES) if args.name == "all" else [args.name]
    args.out.mkdir(parents=True, exist_ok=True)
    output.result({name: BENCHES[name](args) for name in names})
    return 0


def _olat(args: argparse.Namespace) -> dict[str, Any]:
    from appearance.bench_olat import run
    from appearance.hair_appearance import HairAppearance
    from reconstruction.mesh import read_obj
    from reconstruction.rig import Rig
    from reconstruction.strand_files import read_strands

    rig = Rig.load(args.rig)
    with tempfile.TemporaryDirectory() as folder, progress_bar("bench olat") as progress:
        truth = Path(folder)
        progress("making the subject", 0.0)
        _write_truth(args, truth)
        appearance = json.loads((truth / "appearance.json").read_text())
        head = truth / "head.obj"
        progress("rendering", 0.1)
        return run(
            args.out,
            strands=read_strands(truth / "strands.npz"),
            head=read_obj(head) if head.is_file() else None,
            hair=HairAppearance.from_dict(appearance["hair"]),
            skin=tuple(appearance["skin"]),
            camera=rig.cameras[0],
            lights=rig.lights,
            seed=args.seed,
        )


def _acquisition(args: argparse.Namespace) -> dict[str, Any]:
    from stage_service.bench_acquisition import run
    from stage_service.cli.children import Children
    from stage_service.config import RigFile, load_rig_file

    with tempfile.TemporaryDirectory() as scratch, progress_bar("bench acquisition") as progress:
        numbers = iter(range(1000))

        @contextmanager
        def simulate(rig: str) -> Iterator[RigFile]:
            folder = Path(scratch) / str(next(numbers))
            folder.mkdir()
            (folder / "rig.toml").write_text(rig)
            command = [sys.executable, "-m", "simulators", "--rig", str(folder / "rig.toml")]
            command += ["--state", str(folder), "--ports", "auto", "--spp", "1", "--paced"]
            with Children(folder / "logs") as children:
                peers = children.start("simulators", command, answers=True)
                children.first_line("simulators", peers, 120)
                yield load_rig_file(folder / "rig.toml", folder / "devices.toml")

        return run(args.out, simulate, progress)


BENCHES: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "olat": _olat,
    "acquisition": _acquisition,
}


def _write_truth(args: argparse.Namespace, folder: Path) -> None:
    """The subject comes from the simulators, which only they may import."""
    from stage_service.cli.children import simulator_base

    command = [*simulator_base(args), "--truth-only", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        raise CommandError(f"simulators: {lines[-1] if lines else 'failed'}", FAILED)
