"""`hairstage bench`: error against run time of our methods beside the plain ones."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from stage_service.cli.bench import BENCHMARKS
from stage_service.cli.support import (
    FAILED,
    CommandError,
    Output,
    add_command,
    progress_bar,
    rig_path,
    run_command,
)

_DATA, _CAPTURE = "HAIRSTAGE_DATA", "captures/cycles_wavy"


def main() -> int:
    """Run one benchmark, or all; returns the exit code."""
    parser = argparse.ArgumentParser(prog="hairstage")
    bench = add_command(
        parser.add_subparsers(required=True),
        "bench",
        run_bench,
        "measure error against run time",
        "light: our renderers against Mitsuba's own path integrator, light by light and line by "
        "line, and how their cost grows. "
        "agreement: a capture that Blender Cycles rendered, from its true strands. "
        "appearance: stage 1 and its ablations on subjects of known appearance, and on the capture "
        "of agreement. "
        "acquisition: steps and bytes a second beside what wires and disk allow. "
        "photometric: line stereo with and without lightcodes, and fused, on patches of two heads. "
        "lightplanes: strands of three subjects, still and drifting, beside baselines without a "
        f"method; two of them, Sintel and a ponytail, come from ${_DATA}. "
        "all: every one of them. Leaves OUT/<name>.json and OUT/<name>.png.",
    )
    bench.add_argument("name", choices=BENCHMARKS)
    bench.add_argument("--out", type=Path, default=Path("runs/bench"))
    bench.add_argument("--subject", default="wavy", help="wavy, straight, curly or a strand file")
    bench.add_argument("--head", type=Path, help="head mesh (.obj) for a strand file")
    bench.add_argument("--rig", type=rig_path, default="demo")
    bench.add_argument("--capture", type=Path, help=f"for agreement; default: ${_DATA}/{_CAPTURE}")
    bench.add_argument(
        "--only",
        choices=("sintel", "ponytail", "curly", "wavy"),
        help="one subject, for lightplanes (not wavy) and photometric (sintel or wavy)",
    )
    bench.add_argument(
        "--cache", type=Path, default=Path("runs/cache"), help="where simulated captures are kept"
    )
    bench.add_argument("--seed", type=int, default=0)
    bench.add_argument("--seeds", type=int, default=3, help="of appearance's subject (b)")
    return run_command(parser, ["bench", *sys.argv[1:]])


def run_bench(args: argparse.Namespace, output: Output) -> int:
    """Run one benchmark, or all."""
    names = list(BENCHES) if args.name == "all" else [args.name]
    args.out.mkdir(parents=True, exist_ok=True)
    output.result({name: BENCHES[name](args) for name in names})
    return 0


def _light(args: argparse.Namespace) -> dict[str, Any]:
    import numpy as np

    from appearance.scene.hair_appearance import HairAppearance
    from benchmarks.renderers.errors import Subject, run
    from reconstruction.files.strands import read_strands
    from reconstruction.geometry.cameras import Camera
    from reconstruction.geometry.mesh import read_obj
    from reconstruction.geometry.rig import Rig

    def subject(name: str, head: Path | None, sigma_a: tuple[float, float, float] | None) -> Any:
        with tempfile.TemporaryDirectory() as folder:
            truth = Path(folder)
            chosen = argparse.Namespace(rig=args.rig, subject=name, head=head, seed=args.seed)
            _write_truth(chosen, truth)
            appearance = json.loads((truth / "appearance.json").read_text())
            hair = HairAppearance.from_dict(appearance["hair"])
            return Subject(
                read_strands(truth / "strands.npz"),
                read_obj(truth / "head.obj") if (truth / "head.obj").is_file() else None,
                hair if sigma_a is None else replace(hair, sigma_a=sigma_a),
                tuple(appearance["skin"]),
            )

    camera = Rig.load(args.rig).cameras[0]
    fov_deg = float(np.degrees(2 * np.arctan(camera.width / 2 / camera.K[0, 0])))
    ahead = camera.center + camera.R[2]
    small = Camera.look_at(camera.name, 128, 128, camera.center, ahead, fov_deg)
    with progress_bar("bench light") as progress:
        progress("making the subjects", 0.0)
        subjects = {
            Path(args.subject).stem: subject(args.subject, args.head, None),
            # eumelanin of pbrt's table: 0.3 and 8
            "straight blond": subject("straight", None, (0.126, 0.209, 0.411)),
            "black curls": subject("curly", None, (3.35, 5.58, 10.96)),
        }
        return run(args.out, subjects, small, seed=args.seed, progress=progress)


def _agreement(args: argparse.Namespace) -> dict[str, Any]:
    from benchmarks.renderers.agreement import agreement

    folder = args.capture or Path(os.environ.get(_DATA, ".")) / _CAPTURE
    if not folder.is_dir():
        absent = (
            f"bench agreement: no capture at {folder}: name its folder with --capture, "
            f"or the folder that holds {_CAPTURE} in ${_DATA}"
        )
        if args.name == "all":  # whoever has no capture still gets the others
            return {"left_out": absent}
        raise CommandError(absent, FAILED)
    with progress_bar("bench agreement") as progress:
        return agreement(args.out, folder, seed=args.seed, progress=progress)


def _appearance(args: argparse.Namespace) -> dict[str, Any]:
    import numpy as np

    from appearance.scene.hair_appearance import HairAppearance
    from benchmarks.appearance.ablations import run_bench as run
    from benchmarks.appearance.cycles import fit_cycles
    from reconstruction.files.strands import read_strands
    from reconstruction.geometry.mesh import read_obj

    with tempfile.TemporaryDirectory() as folder, progress_bar("bench appearance") as progress:
        truth = Path(folder)
        _write_truth(args, truth)
        appearance = json.loads((truth / "appearance.json").read_text())
        result = run(
            args.out,
            read_strands(truth / "strands.npz"),
            read_obj(truth / "head.obj") if (truth / "head.obj").is_file() else None,
            HairAppearance.from_dict(appearance["hair"]),
            np.array(appearance["skin"]),
            seeds=args.seeds,
            seed=args.seed,
            progress=progress,
        )
        capture = args.capture or Path(os.environ.get(_DATA, ".")) / _CAPTURE
        if capture.is_dir():
            for name, afar in (("cycles", False), ("cycles_from_afar", True)):
                result[name] = fit_cycles(
                    args.out, capture, afar=afar, seed=args.seed, progress=progress
                )
        return result


def _acquisition(args: argparse.Namespace) -> dict[str, Any]:
    from benchmarks.acquisition.rates import run
    from stage_service.cli.support.children import Children
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


def _photometric(args: argparse.Namespace) -> dict[str, Any]:
    from benchmarks.light_codes.photometric import run

    data = os.environ.get(_DATA)
    with progress_bar("bench photometric") as progress:
        out = args.out / "photometric"
        return run(out, Path(data) if data else None, args.cache, args.only, progress)


def _lightplanes(args: argparse.Namespace) -> dict[str, Any]:
    from benchmarks.light_planes.subjects import run

    data = os.environ.get(_DATA)
    with progress_bar("bench lightplanes") as progress:
        out = args.out / "lightplanes"
        return run(out, Path(data) if data else None, args.cache, args.only, progress)


BENCHES: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "renderers": _light,
    "agreement": _agreement,
    "appearance": _appearance,
    "acquisition": _acquisition,
    "light_planes": _lightplanes,
    "light_codes": _photometric,
}


def _write_truth(args: argparse.Namespace, folder: Path) -> None:
    """The subject comes from the simulators, which only they may import."""
    from stage_service.cli.support.children import SimulatedRig

    simulated = SimulatedRig(args.rig, args.subject, args.head, args.seed)
    command = simulated.command("--truth-only", folder)
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        raise CommandError(f"simulators: {lines[-1] if lines else 'failed'}", FAILED)


if __name__ == "__main__":
    sys.exit(main())
