"""Light positions that do not fit the images."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reconstruction import Camera, Capture, CaptureWriter, Light, Rig, Step
from reconstruction.geometry.lights import dome_positions
from reconstruction.images.scene_checks import (
    check_light_axes,
    check_scene,
    odd_lights,
)

BALLS = (([0, 0, 0], 0.1), ([0.09, 0.02, 0.05], 0.05), ([-0.03, 0.1, -0.06], 0.06))
"""A lumpy subject: centres and radii."""
RNG = np.random.default_rng(1)


def cameras() -> list[Camera]:
    out = []
    for i in range(7):
        a = 0.85 * i
        position = [np.cos(a), np.sin(a), 0.5 * np.sin(1.7 * i)]
        out.append(Camera.look_at(f"cam_{i}", 96, 80, position, [0, 0, 0], 28, 20.0 * i))
    return out


def hits(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Depth `(H, W)` along the rays, inf where they meet nothing, and normals `(H, W, 3)`."""
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.rays(np.stack([x, y], axis=-1))
    depth, normal = np.full(x.shape, np.inf), np.zeros((*x.shape, 3))
    for center, radius in BALLS:
        towards = np.array(center) - camera.center
        along = rays @ towards
        inside = along**2 - (towards @ towards - radius**2)
        t = along - np.sqrt(np.maximum(inside, 0))
        nearer = (inside > 0) & (t < depth)
        depth[nearer] = t[nearer]
        points = camera.center + t[..., None] * rays
        normal[nearer] = ((points - center) / radius)[nearer]
    return depth, normal


@pytest.fixture(scope="module")
def lit() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return shown(cameras()[::2])


def shown(stage: list[Camera]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tiles (L, C, T) of the lumps, matte, under 120 lights; places of lights and cameras."""
    lights, pictures = dome_positions(120, 1.5), []
    for camera in stage:
        depth, normal = hits(camera)
        shade = np.maximum(normal @ (lights / 1.5).T, 0) * np.isfinite(depth)[..., None]
        tiles = shade.reshape(8, 10, 8, 12, -1).mean(axis=(1, 3)).reshape(64, -1).T
        pictures.append(tiles + RNG.normal(0, 1e-3, tiles.shape))
    return np.stack(pictures, axis=1), lights, np.array([c.center for c in stage])


def test_lights_with_each_others_pictures_are_found(lit) -> None:
    pictures, places, _ = lit
    assert odd_lights(pictures, places) == {}
    wrong = places.copy()
    wrong[[7, 90]] = wrong[[90, 7]]
    angle = np.degrees(np.arccos(places[7] @ places[90] / 1.5**2))
    assert angle > 60
    found = odd_lights(pictures, wrong)
    assert sorted(found) == [7, 90]
    assert abs(found[7] - angle) < 15


def test_one_light_that_stands_elsewhere_is_found(lit) -> None:
    pictures, places, _ = lit
    wrong = places.copy()
    wrong[41] = places[np.argmin(places @ places[41])]  # across the stage, where another one is
    assert list(odd_lights(pictures, wrong)) == [41]


@pytest.mark.parametrize(
    ("axes", "signs", "named"),
    [
        ((0, 2, 1), (1, 1, 1), "x z y"),
        ((0, 1, 2), (1, -1, -1), "x -y -z"),
        ((2, 0, 1), (1, 1, 1), "y z x"),
    ],
)
def test_lights_in_another_frame_than_the_cameras_give_a_warning(lit, axes, signs, named) -> None:
    pictures, places, eyes = lit
    assert check_light_axes(pictures, places, eyes) == []
    (said,) = check_light_axes(pictures, places[:, axes] * signs, eyes)
    assert f"with the axes {named} by" in said


def test_dark_hair_above_bright_skin_turns_no_axis_round() -> None:
    places = [[np.cos(a), np.sin(a), 0.5 - 0.2 * (a > 2)] for a in (0, 0.8, 1.6, 2.4)]
    above = [Camera.look_at(f"cam_{i}", 96, 80, p, [0, 0, 0], 28) for i, p in enumerate(places)]
    pictures, lights, eyes = shown(above)
    brighter = np.exp(-2.0 * lights[:, 2] / 1.5)  # from below, where skin is, 50 times as bright
    pictures = pictures * brighter[:, None, None]
    assert check_light_axes(pictures, lights, eyes) == []
    (said,) = check_light_axes(pictures, lights[:, [1, 0, 2]] * [-1, 1, 1], eyes)
    assert "with the axes y -x z by" in said


def test_pictures_that_show_nothing_say_nothing() -> None:
    places = dome_positions(30, 1.5)
    assert check_light_axes(np.full((30, 2, 9), 3.0), places, np.eye(3)[:2]) == []
    assert check_light_axes(1 + places[:, :1, None], places, np.eye(3)[:1]) == []  # one camera


def test_a_whole_capture_is_held_against_its_pictures(tmp_path: Path) -> None:
    """As `hairstage import` does it, from frames on disk; only what is said of them changes."""
    stage, places = cameras(), dome_positions(36, 1.5)
    lights = tuple(Light(f"l{i:02d}", p, np.ones(3)) for i, p in enumerate(places))
    steps = [Step(k, "olat", 0.01, light=light.name) for k, light in enumerate(lights)]
    rig = Rig("lumps", tuple(stage), lights)
    writer = CaptureWriter.create(tmp_path / "capture", rig, {"steps": steps})
    for camera in stage:
        depth, normal = hits(camera)
        for step, place in zip(steps, places, strict=True):
            shade = np.maximum(normal @ (place / 1.5), 0) * np.isfinite(depth)
            frame = np.repeat((shade + 1e-3 * RNG.normal(size=shade.shape))[..., None], 3, 2)
            writer.write_frame(step, camera.name, frame.astype(np.float32))
    writer.finish("completed")

    def said(rig: Rig) -> list[str]:
        (tmp_path / "capture" / "rig.json").write_text(json.dumps(rig.to_dict()))
        return check_scene(Capture(tmp_path / "capture"))

    assert said(rig) == []
    wrong = [*lights]
    wrong[20] = replace(lights[20], position=places[np.argmin(places @ places[20])])
    (found,) = said(replace(rig, lights=tuple(wrong)))
    assert found.startswith("l20: ")
