"""The volume that can hold hair."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from reconstruction import Camera, Capture, Mesh, Rig
from reconstruction.growth.hair_envelope import build_envelope
from reconstruction.light_planes import PointCloud
from reconstruction.masks import HairMask, MaskedCapture
from reconstruction.report.report import Stage


def test_hair_that_hangs_far_below_the_head_is_in_the_envelope() -> None:
    """A cylinder of hair, 24 cm wide, from over a head of 18 cm to 60 cm below its middle."""
    low, wide = -0.6, 0.12
    cameras = []
    for azimuth in np.radians(np.arange(0, 360, 60)):
        place = (1.6 * np.sin(azimuth), -1.6 * np.cos(azimuth), -0.25)
        cameras.append(Camera.look_at(f"c{azimuth:.0f}", 90, 200, place, (0, 0, -0.25), 26.0))
    z, a = np.meshgrid(np.linspace(0.1, low, 300), np.linspace(0, 2 * np.pi, 300))
    hair = np.stack([wide * np.cos(a), wide * np.sin(a), z], axis=-1).reshape(-1, 3)
    masks = {}
    for camera in cameras:
        mask = np.zeros((camera.height, camera.width), bool)
        seen, column, row, _ = camera.pixels_of(hair)
        mask[row[seen], column[seen]] = True
        masks[camera.name] = HairMask(mask, mask, mask & False, "user", 1.0)
    capture = Capture.__new__(Capture)
    capture.path, capture.rig = Path("long"), Rig("long", tuple(cameras), (), ())
    head = Mesh(0.09 * OCTAHEDRON, FACES)
    cloud = PointCloud.empty(tuple(c.name for c in cameras), ())
    for longest, reaches in ((0.7, low), (0.2, -0.29)):
        envelope, _ = build_envelope(
            MaskedCapture(capture, masks),
            cloud,
            head,
            grid=6e-3,
            margin=2e-3,
            stage=Stage("envelope"),
            longest=longest,
        )
        assert envelope.centers()[:, 2].min() == pytest.approx(reaches, abs=0.05)


OCTAHEDRON = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
FACES = np.array(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
)
