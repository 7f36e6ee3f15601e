"""Lights of pictures in relative units: as strong as makes what is lit reflect a likely share."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from reconstruction import Light, Rig, import_folder, write_exr
from reconstruction.arrays import Floats
from reconstruction.capture.likely_lights import LIKELY, likely_strength


def matte(albedo: float, unit: float, intensity: float = 8.0, border: int = 0) -> Floats:
    """A white light 2 m away on a matte plane that faces it: L = ρ I / (π d²); in any unit."""
    image = np.full((16, 16, 3), unit * albedo * intensity / np.pi / 4, np.float32)
    return np.pad(image, ((border, border), (border, border), (0, 0)))


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e5])
@pytest.mark.parametrize("border", [0, 40])
def test_a_matte_plane_reflects_what_is_likely(unit: float, border: int) -> None:
    """Whatever the unit, and however much of the picture is dark."""
    light = Light("a", (0.0, -2.0, 0.0), (8.0, 8.0, 8.0))
    found = likely_strength([(light, matte(0.5, unit, border=border))] * 3)
    assert found == pytest.approx(unit * 0.5 / LIKELY, rel=1e-5)


def test_one_picture_in_three_decides_nothing_and_dark_ones_are_passed_over() -> None:
    near, off = (Light("a", (0.0, -2.0, 0.0), (x, x, x)) for x in (8.0, 0.0))
    shown = [(near, matte(a, 1.0)) for a in (0.2, 0.2, 0.9, 0.0)] + [(off, matte(0.9, 1.0))]
    assert likely_strength(shown) == pytest.approx(0.2 / LIKELY, rel=1e-5)
    assert likely_strength([(near, matte(0.0, 1.0))]) == 1
    assert likely_strength([]) == 1


def written(folder: Path, suffix: str, lights: int = 3, dark: tuple[str, ...] = ()) -> Path:
    """Even pictures, a fifth of full, of two cameras, one black; lights of 1 W/sr 2 m away."""
    K = [[30, 0, 7.5], [0, 30, 7.5], [0, 0, 1]]
    pose = {"width": 16, "height": 16, "K": K, "R": np.eye(3).tolist()}
    cameras = [{"id": c, **pose, "t": [i, 0, 1]} for i, c in enumerate(("left", "right"))]
    names = [f"light_{k:03d}" for k in range(lights)]
    place = {"position": [0, 0, -2], "intensity": [1, 1, 1]}
    for camera in ("left", "right"):
        (folder / "images" / camera).mkdir(parents=True)
        image = np.full((16, 16, 3), 0.0 if camera in dark else 0.2, np.float32)
        for name in names:
            file = folder / "images" / camera / (name + suffix)
            if suffix == ".exr":
                write_exr(file, image)
            else:
                cv2.imwrite(str(file), np.rint(image * 65535).astype(np.uint16))
    (folder / "cameras.json").write_text(json.dumps({"cameras": cameras}))
    lit = [{"id": n, **place} for n in names]
    (folder / "lights.json").write_text(json.dumps({"lights": lit}))
    return folder


def test_import_assumes_equal_light_intensities_and_warns(tmp_path: Path) -> None:
    """A matte plane sends ρ/(4 π) of such a light."""
    capture = import_folder(written(tmp_path / "folder", ".png"), tmp_path / "out")
    strength = Rig.load(capture.path / "rig.json").lights[0].intensity[0]
    assert strength == pytest.approx(0.2 * 4 * np.pi / LIKELY, rel=1e-3)
    assert "intensities are multiplied by 12.6" in " ".join(capture.plan["import"]["notes"])
    assert capture.frame(capture.steps[0], "left").mean() == pytest.approx(0.2, rel=1e-3)


def test_floats_are_radiance_and_their_lights_stay(tmp_path: Path) -> None:
    capture = import_folder(written(tmp_path / "folder", ".exr"), tmp_path / "out")
    assert (Rig.load(capture.path / "rig.json").lights[0].intensity == 1).all()
    assert "multiplied" not in " ".join(capture.plan["import"]["notes"])


@pytest.mark.parametrize("dark", ["left", "right"])
def test_sampled_frames_cover_all_cameras(tmp_path: Path, dark: str) -> None:
    """Every fourth frame is always of the first of two cameras."""
    folder = written(tmp_path / "folder", ".png", lights=96, dark=(dark,))
    capture = import_folder(folder, tmp_path / "out")
    strength = Rig.load(capture.path / "rig.json").lights[0].intensity[0]
    assert strength == pytest.approx(0.2 * 4 * np.pi / LIKELY, rel=1e-3)
