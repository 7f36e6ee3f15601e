"""Photographs of a person under calibrated near LEDs (github.com/yqueau/near_ps, Human1)."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from reconstruction.files.lights import read_lights
from reconstruction.files.pictures import Sensor, picture_size, read_picture
from reconstruction.geometry.lights import Light

DATA = Path(os.environ.get("HAIRSTAGE_DATA", "")) / "near_ps"
LAMPS = (1, 2, 3, 4, 6, 7, 8)
HEAD = np.array([0.0, 0.0, 600.0])  # mm from the camera, about


def grey(name: str) -> np.ndarray:
    path = DATA / f"{name}.png"
    # raw sensor values in 8 bits, though the type of the files suggests sRGB
    return read_picture(path, Sensor(response="linear"), picture_size(path)).light.mean(axis=-1)


def spread(lights: dict[int, Light], images: dict[int, np.ndarray]) -> float:
    """Scatter of log(predicted / photographed light), each lamp from the three nearest others."""
    sent = {
        k: x.intensity_towards(HEAD).mean() / np.square(x.position - HEAD).sum()
        for k, x in lights.items()
    }
    levels = []
    for k in lights:
        ahead = {
            n: (x.position - HEAD) / np.linalg.norm(x.position - HEAD) for n, x in lights.items()
        }
        angle = {n: np.arccos(np.clip(ahead[n] @ ahead[k], -1, 1)) for n in lights if n != k}
        near = sorted(angle, key=lambda n: angle[n])[:3]
        weight = np.array([1 / angle[n] for n in near])
        total = sum(w * images[n].sum() / sent[n] for w, n in zip(weight, near, strict=True))
        levels.append(total / weight.sum() * sent[k] / images[k].sum())
    return float(np.std(np.log(levels)))


@pytest.mark.skipif(not DATA.is_dir(), reason="HAIRSTAGE_DATA has no near_ps")
def test_axes_of_real_lamps_explain_the_photographs() -> None:
    lights = read_lights(DATA / "light.mat").lights
    size = picture_size(DATA / "ambient.png")
    mask = cv2.imread(str(DATA / "mask_raw.png"), cv2.IMREAD_GRAYSCALE)  # of larger pictures
    person, dark = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) > 127, grey("ambient")
    images = {k: (grey(f"led_{k:04d}") - dark)[person] for k in LAMPS}
    of_lamp = {k: lights[k - 1] for k in LAMPS}
    alike = {k: replace(x, orientation=None, profile=None) for k, x in of_lamp.items()}
    with_axes, without = spread(of_lamp, images), spread(alike, images)
    assert with_axes < 0.1
    assert without > 1.5 * with_axes
