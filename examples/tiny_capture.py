"""A capture that is rendered in seconds, for examples that are given none."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from appearance import HairAppearance, build_scene, render_olat
from reconstruction import Camera, CaptureWriter, Light, Rig, Step, Strands, write_strands
from reconstruction.geometry.lights import dome_positions

FIBRE = HairAppearance(sigma_a=(0.25, 0.45, 0.9), beta_m=0.25, beta_n=0.3)
"""Blond hair; absorption per fibre radius."""
CAMERAS, SIZE, LIGHTS = 4, 32, 331


def wig(strands: int = 1500, points: int = 24, seed: int = 0) -> Strands:
    """Wavy strands on a ball of 8 cm, from the crown downwards."""
    rng = np.random.default_rng(seed)
    azimuth = rng.uniform(0, 2 * np.pi, (strands, 1))
    start = np.arccos(rng.uniform(0.3, 1.0, (strands, 1)))
    polar = start + np.linspace(0, 1.2, points)
    swing = azimuth + 0.08 * np.sin(9 * polar + rng.normal(0, 0.3, (strands, 1)))
    radius = 0.08 + rng.uniform(0, 0.004, (strands, 1))
    unit = [np.sin(polar) * np.cos(swing), np.sin(polar) * np.sin(swing), np.cos(polar)]
    xyz = radius[..., None] * np.stack(unit, axis=-1)
    offsets = points * np.arange(strands + 1)
    return Strands(xyz.reshape(-1, 3).astype(np.float32), offsets, radius=6e-4)


def stage() -> Rig:
    """Cameras around the subject and a dome of lights."""
    angles = 2 * np.pi * np.arange(CAMERAS) / CAMERAS
    places = [(0.8 * np.sin(a), -0.8 * np.cos(a), (0.1, 0.5)[k % 2]) for k, a in enumerate(angles)]
    cameras = [
        Camera.look_at(f"cam_{k:02d}", SIZE, SIZE, place, (0, 0, 0), 15.0)
        for k, place in enumerate(places)
    ]
    lights = [
        Light(f"light_{k:03d}", place, np.array([8.0, 8.0, 8.0]))
        for k, place in enumerate(dome_positions(LIGHTS, 1.2, -50.0))
    ]
    return Rig("tiny", tuple(cameras), tuple(lights))


def tiny_capture(folder: str | Path = "runs/tiny") -> Path:
    """The capture folder; rendered if it is not there. Beside it lies `truth.npz`, its strands."""
    folder = Path(folder)
    path = folder / "capture"
    if (path / "manifest.json").exists():
        return path
    rig, strands = stage(), wig()
    scene = build_scene(strands, None, hair=FIBRE)
    frames = {c.name: render_olat(scene, c, rig.lights, spp=4, max_depth=4) for c in rig.cameras}
    steps = [
        Step(index=k, kind="olat", exposure=0.02, light=light.name)
        for k, light in enumerate(rig.lights)
    ]
    masks = {name: stack.sum(axis=(0, 3)) > 0 for name, stack in frames.items()}
    writer = CaptureWriter.create(path, rig, {"steps": steps}, masks=masks)
    stored = [
        writer.store_frame(step, name, stack[step.index])
        for step in steps
        for name, stack in frames.items()
    ]
    writer.commit(stored)
    writer.finish("completed")
    write_strands(folder / "truth.npz", strands)
    return path
