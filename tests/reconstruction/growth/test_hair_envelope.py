"""The volume that can hold hair."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reconstruction import Camera, Capture, CaptureError, Mesh, Rig
from reconstruction.growth.hair_envelope import build_envelope, build_hull
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
        visible, column, row, _ = camera.pixels_of(hair)
        mask[row[visible], column[visible]] = True
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


RADIUS = 0.1


def ball_capture(face: float) -> MaskedCapture:
    """A ball seen from eight sides, all hair but for what is further than `face` to the front."""
    cameras, masks = [], {}
    for k, a in enumerate(np.radians(np.arange(8) * 45.0)):
        place = (1.2 * np.sin(a), -1.2 * np.cos(a), (0.3, -0.3)[k % 2])
        camera = Camera.look_at(f"c{k}", 120, 120, place, (0, 0, 0), 12.0)
        rays = camera.rays(np.stack(np.meshgrid(np.arange(120), np.arange(120)), axis=-1))
        b = rays @ camera.center
        square = b**2 - camera.center @ camera.center + RADIUS**2
        point = camera.center + (-b - np.sqrt(np.maximum(square, 0)))[..., None] * rays
        subject, skin = square > 0, point[..., 1] < -face
        masks[camera.name] = HairMask(subject, subject & ~skin, subject & skin, "user", 1.0)
        cameras.append(camera)
    capture = Capture.__new__(Capture)
    capture.path, capture.rig = Path("ball"), Rig("ball", tuple(cameras), (), ())
    return MaskedCapture(capture, masks)


def test_a_face_without_a_head_is_bare_and_hides_no_hair() -> None:
    """Cameras in front see skin alone where hair lies behind the head."""
    masked = ball_capture(face=0.05)
    hull, bare, depths = build_hull(masked, grid=3e-3, stage=Stage("envelope"))
    behind, before, middle = np.array([[0, 0.095, 0], [0, -0.095, 0], [0, 0, 0.0]])
    assert hull.contains(behind[None])[0]
    assert not hull.contains(np.stack([before, middle])).any()
    rest = replace(hull, inside=bare)
    assert rest.contains(np.stack([before, middle])).all()
    assert not (hull.inside & bare).any()
    off = np.linalg.norm(hull.centers(), axis=1)
    assert off.min() > RADIUS - 0.03  # rays through a ball's rim are longer in the shell than deep
    from_behind = depths["c4"][60, 60]
    assert from_behind == pytest.approx(np.hypot(1.2, 0.3) - RADIUS, abs=3.4e-3)
    assert depths["c0"][60, 60] == 0  # a pixel of skin


def test_a_camera_that_shows_skin_alone_has_its_say_and_skin_alone_is_no_hair() -> None:
    masked = ball_capture(face=0.0)
    front = masked.masks["c0"]
    assert not front.hair[45:75, 45:75].any()
    bald = replace(front, hair=front.hair & False, skin=front.subject)
    masks = {**masked.masks, "c0": bald}
    hull, bare, depths = build_hull(
        MaskedCapture(masked.capture, masks), grid=3e-3, stage=Stage("envelope")
    )
    assert hull.contains(np.array([[0, 0.095, 0]]))[0]
    assert replace(hull, inside=bare).contains(np.array([[0, -0.095, 0]]))[0]
    assert not depths["c0"].any()
    every = {k: replace(m, hair=m.hair & False, skin=m.subject) for k, m in masks.items()}
    with pytest.raises(CaptureError, match="no volume"):
        build_hull(MaskedCapture(masked.capture, every), grid=3e-3, stage=Stage("envelope"))


def test_without_any_skin_all_of_the_hull_can_be_hair() -> None:
    hull, bare, _ = build_hull(ball_capture(face=1.0), grid=3e-3, stage=Stage("envelope"))
    assert hull.contains(np.zeros((1, 3)))[0]
    assert not bare.any()
    assert hull.inside.sum() * 3e-3**3 == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.04)


OCTAHEDRON = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
FACES = np.array(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
)
