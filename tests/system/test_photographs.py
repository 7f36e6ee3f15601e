"""Photographs under constant light, in GaussianHaircut's layout: from a COLMAP folder to Blender.

The layout is that of the authors' run.sh, convert.py and calc_masks.py: `images/NAME.png`,
`sparse/0`, `masks/hair`, `masks/body` and `masks/face`, in COLMAP's unit. The subject is a ball
whose hair crosses the meridians at 40 degrees, before wallpaper.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import camera_writers as writers
import cv2
import numpy as np
import pytest

from reconstruction import Camera, Report, read_strands
from stage_service.cli import main

SIZE, RADIUS, COUNT = 72, 0.03, 8
UNIT = 0.37
"""Metres, of COLMAP's model."""
CENTER = np.array([0.4, -0.3, 0.2])
"""The subject's, metres."""
LIGHT = np.array([0.5, -0.6, 0.7])
SLANT = np.radians(40)
"""Of the hair to the meridians; strands that are guessed run down these."""


def camera(k: int) -> Camera:
    a, e = 2 * np.pi * k / COUNT, 0.35 * np.cos(1.9 * k)
    away = 0.6 * np.array([np.sin(a) * np.cos(e), -np.cos(a) * np.cos(e), np.sin(e)])
    return Camera.look_at(f"{k + 1:06d}", SIZE, SIZE, CENTER + away, CENTER, 6.6)


def photograph(of: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The picture `(H, W, 3)` of 8 bits, and the masks `(H, W)` of the hair and the body."""
    sub = (np.arange(3) + 0.5) / 3 - 0.5
    grid = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), axis=-1)
    offsets = np.stack(np.meshgrid(sub, sub), axis=-1).reshape(-1, 2)
    rays = of.rays(grid[:, :, None] + offsets)
    eye = of.center - CENTER
    b = rays @ eye
    inside = b**2 - (eye @ eye - RADIUS**2)
    p = eye + (-b - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
    body = inside > 0
    hair = body & (p[..., 2] > -0.5 * RADIUS)
    latitude = np.arctanh(np.clip(p[..., 2] / RADIUS, -0.99, 0.99))  # Mercator's
    across = np.arctan2(p[..., 1], p[..., 0]) - np.tan(SLANT) * latitude
    albedo = 0.3 + sum(0.07 * np.cos(k * across + k) for k in (17, 29, 41))
    shade = 0.4 + 0.6 * np.maximum(p @ LIGHT / RADIUS / np.linalg.norm(LIGHT), 0)
    wall = 0.45 + 0.25 * np.sin(40 * rays[..., 0]) * np.sin(55 * rays[..., 2])
    light = np.where(hair, albedo * shade, np.where(body, 0.6 * shade, wall)).mean(axis=-1)
    bits = 255 * np.where(light > 0.0031308, 1.055 * light ** (1 / 2.4) - 0.055, 12.92 * light)
    picture = np.repeat(bits.round().astype(np.uint8)[..., None], 3, axis=2)
    return picture, hair.mean(axis=-1) >= 0.5, body.mean(axis=-1) >= 0.5


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("scene")
    cameras = [camera(k) for k in range(COUNT)]
    in_colmap = [replace(c, t=c.t / UNIT) for c in cameras]
    writers.write_colmap_binary(out / "sparse" / "0", in_colmap)
    for c in cameras:
        picture, hair, body = photograph(c)
        masks = {"hair": hair, "body": body, "face": body & ~hair}
        images = {f"masks/{name}": 255 * mask.astype(np.uint8) for name, mask in masks.items()}
        for place, image in ({"images": picture} | images).items():
            (out / place).mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(out / place / f"{c.name}.png"), image)
    return out


def test_photographs_become_strands_and_a_groom(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture, model, out = (str(tmp_path / name) for name in ("capture", "model", "hair"))
    assert main(["import", str(folder), "--out", capture, "--unit", str(UNIT)]) == 0
    said = capsys.readouterr()
    assert f"{COUNT} cameras, 0 lights, {COUNT} frames, 0 missing" in said.out
    assert "no lights: photographs under constant light" in said.err

    quick = json.dumps({"grid": 3e-3, "max_length": 0.06, "measure": {"thin": 3e-3}})
    assert main(["reconstruct", capture, "--out", model, "--options", quick]) == 0
    assert f"{COUNT} photographs under constant light" in capsys.readouterr().err
    report = Report.load(Path(model) / "report.json")
    assert {x.what for x in report["lightcodes"].left_out} == {"lightcodes"}
    assert "there are no single lights" in {x.why for x in report["orientation"].left_out}
    assert set(report["masks"].figures["source"].values()) == {"user"}

    # along the hair, near the surface, where the hair mask is
    strands = read_strands(Path(model) / "strands.npz")
    points = UNIT * strands.points - CENTER
    radius = np.linalg.norm(points, axis=1)
    assert np.quantile(radius, 0.99) < 1.1 * RADIUS
    assert np.quantile(points[:, 2], 0.01) > -0.8 * RADIUS
    outer = (radius > 0.94 * RADIUS) & (np.abs(points[:, 2]) < 0.6 * RADIUS)
    assert outer.sum() > 1000
    n = points[outer] / radius[outer, None]
    north = np.array([0, 0, 1.0]) - n[:, 2:] * n
    north /= np.linalg.norm(north, axis=1, keepdims=True)
    along = np.cos(SLANT) * north + np.sin(SLANT) * np.cross(north, n)
    cosine = np.abs((strands.tangents()[outer] * along).sum(axis=1))
    off = np.degrees(np.arccos(cosine.clip(0, 1)))
    assert np.median(off) < 12
    assert (off < 25).mean() > 0.75

    assert main(["export", model, "--to", "blender", "--out", out]) == 0
    assert {p.name for p in Path(out).iterdir()} == {"open_in_blender.py", "groom.npz"}
    capsys.readouterr()
    assert main(["fit", capture, model]) == 3
    assert "photographs under constant light do not determine" in capsys.readouterr().err


def test_photographs_without_masks_are_refused_with_the_masks_to_give(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """After run.sh has removed the full images: halves in images_2; the wall is lit."""
    bare = tmp_path / "bare"
    shutil.copytree(folder / "sparse", bare / "sparse")
    (bare / "images_2").mkdir()
    for path in (folder / "images").iterdir():
        half = cv2.resize(cv2.imread(str(path)), (SIZE // 2, SIZE // 2))
        cv2.imwrite(str(bare / "images_2" / path.name), half)
    capture = str(tmp_path / "capture")
    assert main(["import", str(bare), "--out", capture, "--unit", str(UNIT)]) == 0
    assert main(["reconstruct", capture, "--out", str(tmp_path / "model")]) == 3
    assert "provide masks of the subject (subjects/CAMERA.png)" in capsys.readouterr().err


def test_images_of_single_lights_without_lights_name_the_option(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = tmp_path / "scene"
    shutil.copytree(folder / "sparse", scene / "sparse")
    for path in (folder / "images").iterdir():
        (scene / "images" / path.stem).mkdir(parents=True)
        shutil.copy(path, scene / "images" / path.stem / "light_00.png")
    words = ["import", str(scene), "--out", str(tmp_path / "capture"), "--unit", str(UNIT)]
    assert main(words) == 3
    assert "or lights (lights.json, --lights)" in capsys.readouterr().err
