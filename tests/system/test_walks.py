"""The README's way from photographs to strands in Blender, as a new user types it."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reconstruction import Camera, Model, Strands, read_strands
from reconstruction.geometry.lights import dome_positions

README = Path(__file__).parents[2] / "README.md"
SIZE, RADIUS, MM = 56, 0.1, 1000.0
FULL = 0.16
"""The light at which a channel is full: some highlights are above it."""


def photograph(camera: Camera, light: np.ndarray) -> np.ndarray:
    """A ball of fibres that run from pole to pole, after Kajiya and Kay, `(H, W, 3)`."""
    grid = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), axis=-1)
    rays = camera.rays(grid)
    b = rays @ camera.center
    inside = b**2 - (camera.center @ camera.center - RADIUS**2)
    p = camera.center + (-b - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
    n = p / RADIUS
    tangent = np.cross(np.cross(n, [0, 0, 1.0]), n)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=-1, keepdims=True), 1e-9)
    away = light - p
    far = np.linalg.norm(away, axis=-1, keepdims=True)
    to = away / far
    along, eye = (tangent * to).sum(axis=-1), -(tangent * rays).sum(axis=-1)
    shine = np.exp(-(((along + eye) / 0.2) ** 2))
    phi = np.arctan2(p[..., 1], p[..., 0])
    fibres = 1 + 0.35 * np.cos(60 * phi) + 0.25 * np.cos(97 * phi + 1)
    facing = np.maximum((n * to).sum(axis=-1), 0) / far[..., 0] ** 2
    lit = (0.1 * np.sqrt(np.maximum(1 - along**2, 0)) + 0.2 * shine) * fibres * facing
    return np.where(inside > 0, lit, 0)[..., None] * np.array([1.0, 0.7, 0.45])


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    """Eight cameras by COLMAP, 64 lights, noisy 16-bit PNG; no head, no sweep; some are lost."""
    rng, folder = np.random.default_rng(0), tmp_path / "photographs"
    (folder / "sparse" / "0").mkdir(parents=True)
    azimuths = np.radians(np.arange(8) * 45.0)
    places = [
        (0.9 * np.sin(a), -0.9 * np.cos(a), (0.1, 0.4)[k % 2]) for k, a in enumerate(azimuths)
    ]
    cameras = [
        Camera.look_at(f"DSC_{k}", SIZE, SIZE, p, (0, 0, 0), 15.0) for k, p in enumerate(places)
    ]
    lights = dome_positions(64, 1.2, -50.0)
    lines, images = [], []
    for k, c in enumerate(cameras, 1):
        lines.append(f"{k} PINHOLE {SIZE} {SIZE} {c.K[0, 0]} {c.K[1, 1]} {SIZE / 2} {SIZE / 2}\n")
        x, y, z, w = Rotation.from_matrix(c.R).as_quat()
        t = " ".join(str(v) for v in MM * c.t)
        images.append(f"{k} {w} {x} {y} {z} {t} {k} {c.name}/colmap.png\n\n")
    (folder / "sparse/0/cameras.txt").write_text("".join(lines))
    (folder / "sparse/0/images.txt").write_text("".join(images))
    rows = "\n".join(
        f"led_{i:03d},{x:.2f},{y:.2f},{z:.2f}" for i, (x, y, z) in enumerate(MM * lights)
    )
    (folder / "lights.csv").write_text(f"name,x,y,z\n{rows}\n")
    for c in cameras:
        (folder / "images" / c.name).mkdir(parents=True)
        for i, light in enumerate(lights):
            noisy = photograph(c, light) / FULL + rng.normal(0, 2e-3, (SIZE, SIZE, 3))
            counts = np.round(np.clip(noisy, 0, 1) * 65535).astype(np.uint16)
            if rng.random() > 0.05:
                file = folder / "images" / c.name / f"led_{i:03d}.png"
                assert cv2.imwrite(str(file), counts[..., ::-1])
    return folder


def typed(line: str, *more: str, cwd: Path) -> str:
    """Run a line of the README; returns what it printed."""
    words = [
        sys.executable,
        "-m",
        "stage_service.cli",
        *shlex.split(line, comments=True)[1:],
        *more,
    ]
    done = subprocess.run(
        words, cwd=cwd, capture_output=True, text=True, timeout=1200, env=os.environ
    )
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def polar_error(strands: Strands) -> float:
    """Median degrees between the strands and the ball's meridians."""
    p, along = strands.points[:-1], np.diff(strands.points, axis=0)
    same = strands.strand_of_point[1:] == strands.strand_of_point[:-1]
    p, along = p[same], along[same]
    away = np.linalg.norm(p[:, :2], axis=1) > 0.04  # at the poles there is no direction
    n = p[away] / np.linalg.norm(p[away], axis=1, keepdims=True)
    truth = np.cross(np.cross(n, [0, 0, 1.0]), n)
    cosine = (truth * along[away]).sum(axis=1) / np.maximum(
        np.linalg.norm(truth, axis=1) * np.linalg.norm(along[away], axis=1), 1e-12
    )
    return float(np.median(np.degrees(np.arccos(np.clip(np.abs(cosine), 0, 1)))))


@pytest.mark.slow
def test_three_commands_lead_from_photographs_to_strands_in_blender(photographs, tmp_path):
    """Typed as the README prints them; what they ask for on the way is given as they say."""
    lines = re.findall(
        r"^    (hairstage (?:import|reconstruct|export) .*)$", README.read_text(), re.M
    )
    first, second, third = lines[0], lines[1], next(x for x in lines if "export model --to" in x)
    first = first.replace("FOLDER", "photographs")
    said = subprocess.run(
        [sys.executable, "-m", "stage_service.cli", *shlex.split(first, comments=True)[1:]],
        cwd=tmp_path, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert said.returncode != 0
    assert "give --unit mm" in said.stderr  # nothing in COLMAP's files says it
    typed(first, "--unit", "mm", cwd=tmp_path)
    options = json.dumps({"grid": 5e-3, "within": 4e-3})
    said = typed(second, "--options", options, cwd=tmp_path)
    assert "no sweep, 64 single lights, no head: method hull" in said
    given = read_strands(tmp_path / "model" / "strands.npz").points / MM  # as COLMAP's numbers
    strands = Model(tmp_path / "model").strands()
    np.testing.assert_allclose(given, strands.points, atol=1e-6)
    distance = np.linalg.norm(strands.points, axis=1)
    assert len(strands) > 100
    # the surface, and what is filled under it
    assert np.percentile(distance, 99) == pytest.approx(RADIUS, abs=8e-3)
    assert polar_error(strands) < 10
    said = typed(third, cwd=tmp_path)
    assert "has no fit" in said
    assert "open_in_blender.py" in said
    assert (tmp_path / "hair" / "open_in_blender.py").is_file()
