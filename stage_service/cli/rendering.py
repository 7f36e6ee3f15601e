"""`render`: a picture of a model."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from appearance.metrics.pictures import write_png
from appearance.metrics.scores import Exposure, srgb
from appearance.model.fitted_model import FittedModel
from appearance.model.relight import environment_map, three_quarter_view
from appearance.render.mixed import Environment
from reconstruction.arrays import Floats
from reconstruction.capture.folder import Capture
from reconstruction.files.durable import writing
from reconstruction.files.exr import write_exr
from reconstruction.model import Model
from reconstruction.report.report import Progress

SIZE = 512
"""Pixels across, where no camera of a rig says."""


def render_model(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Render what the arguments of `hairstage render` ask for; returns what was written."""
    start = time.perf_counter()
    if args.out is not None and args.out.suffix not in (".png", ".exr"):
        raise ValueError(f"--out {args.out}: expected .png or .exr")
    capture = Capture(args.capture) if args.capture is not None else None
    if capture is None and (args.camera is not None or args.light):
        raise ValueError("--camera and --light name parts of a rig: say whose with --capture")
    progress("building the scene", 0.0)
    fitted = FittedModel.load(Model(args.model), capture)
    camera = three_quarter_view(fitted.strands, SIZE)
    if capture is not None and args.camera is not None:
        camera = capture.rig.camera(args.camera)
    environment = args.environment or (None if args.light else "studio")
    maps = [] if environment is None else [Environment(environment_map(environment))]
    lights = fitted.lights(args.light) if args.light else []
    progress("rendering", 0.2)
    image = fitted.render(camera, lights, maps, spp=args.spp, seed=args.seed)
    out: Path = args.out or args.model / f"render_{camera.name}.png"
    with writing(out) as part:
        _write(part, image)
    progress("written", 1.0)
    return {
        "image": str(out),
        "camera": camera.name,
        "lights": args.light,
        "environment": environment,
        "seconds": time.perf_counter() - start,
    }


def _write(out: Path, image: Floats) -> None:
    if out.suffix == ".exr":
        write_exr(out, image)
    else:
        lit = image[image.sum(axis=-1) > 0]
        write_png(out, srgb(image) if not len(lit) else Exposure.of([lit])(image))
