"""`render`: a picture of a model."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from appearance.metrics.pictures import write_png
from appearance.metrics.scores import Exposure, srgb
from appearance.model.fitted_appearance import FittedAppearance
from appearance.model.relight import PROCEDURAL, three_quarter_view
from appearance.render.environment import render_environment
from appearance.render.environment_maps import load_environment
from appearance.render.olat import render_olat
from appearance.scene.hair_scene import HairScene, build_scene
from reconstruction.arrays import Floats
from reconstruction.capture.folder import Capture
from reconstruction.files.exr import write_exr
from reconstruction.files.strands import read_strands
from reconstruction.geometry.cameras import Camera
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
    if capture is None and (args.camera is not None or args.light is not None):
        raise ValueError("--camera and --light name parts of a rig: say whose with --capture")
    progress("building the scene", 0.0)
    appearance = FittedAppearance.load(args.model)
    strands = read_strands(args.model / "strands.npz")
    camera = three_quarter_view(strands, SIZE)
    if capture is not None and args.camera is not None:
        camera = capture.rig.camera(args.camera)
    scene = build_scene(
        strands,
        Model(args.model).head(capture),
        hair=appearance.hair,
        skin=appearance.skin,
    )
    progress("rendering", 0.2)
    if args.light is not None:
        assert capture is not None
        light = capture.rig.light(args.light)
        image = render_olat(scene, camera, [light], spp=args.spp, seed=args.seed)[0]
    else:
        image = _environment(scene, camera, args)
    out: Path = args.out or args.model / f"render_{camera.name}.png"
    _write(out, image)
    progress("written", 1.0)
    return {
        "image": str(out),
        "camera": camera.name,
        "light": args.light,
        "environment": None if args.light is not None else args.environment,
        "seconds": time.perf_counter() - start,
    }


def _environment(scene: HairScene, camera: Camera, args: argparse.Namespace) -> Floats:
    procedural = PROCEDURAL.get(args.environment)
    envmap = procedural() if procedural is not None else load_environment(Path(args.environment))
    return render_environment(scene, camera, envmap, spp=args.spp, seed=args.seed)


def _write(out: Path, image: Floats) -> None:
    if out.suffix == ".exr":
        write_exr(out, image)
    else:
        lit = image[image.sum(axis=-1) > 0]
        write_png(out, srgb(image) if not len(lit) else Exposure.of([lit])(image))
