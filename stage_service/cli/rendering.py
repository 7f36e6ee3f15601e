"""`render`: a picture of a model."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from appearance.fitted import FittedAppearance
from appearance.metrics import srgb
from appearance.render.environment import load_environment, render_environment, sky, studio
from appearance.render.olat import render_olat
from appearance.scene import HairScene, build_scene
from reconstruction.cameras import Camera
from reconstruction.capture import Capture
from reconstruction.exr import write_exr
from reconstruction.report import Progress
from reconstruction.strand_files import read_strands

FRONT = Camera.look_at("front", 512, 512, (0.3, -0.9, 0.15), (0.0, 0.0, 0.0), 24.0)


def render_model(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Render what the arguments of `hairstage render` ask for; returns what was written."""
    start = time.perf_counter()
    capture = Capture(args.capture) if args.capture is not None else None
    if capture is None and (args.camera is not None or args.light is not None):
        raise ValueError("--camera and --light name parts of a rig: say whose with --capture")
    camera = FRONT
    if capture is not None:
        rig = capture.rig
        camera = rig.cameras[0] if args.camera is None else rig.camera(args.camera)
    progress("building the scene", 0.0)
    appearance = FittedAppearance.load(args.model)
    scene = build_scene(
        read_strands(args.model / "strands.npz"),
        capture.head if capture is not None else None,
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


def _environment(scene: HairScene, camera: Camera, args: argparse.Namespace) -> NDArray[np.float32]:
    procedural = {"studio": studio, "sky": sky}.get(args.environment)
    envmap = procedural() if procedural is not None else load_environment(Path(args.environment))
    return render_environment(scene, camera, envmap, spp=args.spp, seed=args.seed)


def _write(out: Path, image: NDArray[np.float32]) -> None:
    if out.suffix == ".exr":
        write_exr(out, image)
        return
    if out.suffix != ".png":
        raise ValueError(f"{out}: expected .png or .exr")
    white = float(np.percentile(image, 99.5))
    picture = np.rint(255 * srgb(image / white if white > 0 else image))
    if not cv2.imwrite(str(out), picture[..., ::-1].astype(np.uint8)):
        raise OSError(f"{out} cannot be written")
