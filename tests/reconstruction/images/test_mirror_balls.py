"""Lights by mirror balls, on pictures of reflecting spheres that are made ray by ray here."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from reconstruction import Camera, write_exr
from reconstruction.capture.grey_ball import Circle
from reconstruction.files.lights import read_lights
from reconstruction.images.colour_chart import find_balls
from reconstruction.images.mirror_balls import Reflection, group, highlights, locate, reflect
from stage_service.cli import main

SIZE, RADIUS, FINE = 200, 0.03, 2
EYES = {"left": (-0.35, -0.8, 0.05), "right": (0.35, -0.8, 0.1)}
BALLS = np.array([[-0.055, 0.0, 0.02], [0.06, 0.01, -0.03]])
ANGLES = np.radians([(-150, 20), (-120, -25), (-90, 50), (-60, 0), (-30, 35)])
LIGHTS = {
    f"led_{k}": 1.2 * np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    for k, (a, e) in enumerate(ANGLES)
}


def camera(name: str) -> Camera:
    """A ball's radius is 28 pixels."""
    return Camera.look_at(name, SIZE, SIZE, np.array(EYES[name]), np.zeros(3), 14.0)


def picture(
    eye: Camera, lamps: list[np.ndarray], balls: np.ndarray = BALLS, blur: float = 0.7,
    noise: float = 1e-3, matt: bool = False, seed: int = 0, full: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Grey radiance `(H, W)` and saturated pixels: balls in a dim room, before clutter."""
    x, y = np.meshgrid(*[(np.arange(FINE * SIZE) + 0.5) / FINE - 0.5] * 2)
    w = eye.rays(np.stack([x, y], axis=-1))
    clutter = np.random.default_rng(7).uniform(0.06, 0.15, (10, 10))
    image = np.kron(clutter, np.ones((FINE * SIZE // 10,) * 2))
    for ball in balls:
        to = ball - eye.center
        inside = RADIUS**2 - (to @ to - (w @ to) ** 2)
        hit = inside > 0
        ray = w[hit]
        n = (eye.center + (ray @ to - np.sqrt(inside[hit]))[:, None] * ray - ball) / RADIUS
        r = ray - 2 * (ray * n).sum(axis=1)[:, None] * n
        shade = 0.02 + 0.02 * np.maximum(r[:, 2], 0)
        for lamp in lamps:
            away = lamp - ball - RADIUS * n
            away /= np.linalg.norm(away, axis=1)[:, None]
            lambert, mirrored = (np.maximum((v * away).sum(axis=1), 0) for v in (n, r))
            shade = shade + (0.5 * lambert if matt else 40.0 * (mirrored > np.cos(0.02)))
        image[hit] = shade
    image = cv2.GaussianBlur(cv2.resize(image, (SIZE, SIZE), interpolation=3), (0, 0), blur)
    image += np.random.default_rng(seed).normal(0, noise, image.shape)
    return np.minimum(image, full).astype(np.float32), image >= full


def shot(eye: Camera, **how: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    return {n: picture(eye, [p], seed=k, **how) for k, (n, p) in enumerate(LIGHTS.items())}


def outline(eye: Camera, ball: np.ndarray) -> Circle:
    """The true circle, of a ball near the axis."""
    (x, y), depth = eye.project(ball)
    return float(x), float(y), float(eye.K[0, 0] * RADIUS / np.sqrt(depth**2 - RADIUS**2))


def rays_of(
    eye: Camera, circle: Circle, center: np.ndarray | None, radius: float, pixels: dict
) -> list[Reflection]:
    rays = [reflect(eye, circle, center, radius, n, at) for n, at in pixels.items()]
    return [r for r in rays if r is not None]


def found_balls(image: np.ndarray) -> list[Circle]:
    return find_balls(np.repeat(image[..., None], 3, axis=2))


@pytest.mark.parametrize(
    ("how", "most"),
    [
        ({"full": np.inf}, 3.0),
        ({"full": 0.2}, 3.0),  # clipped
        ({"blur": 2.0}, 3.0),  # out of focus
        ({"noise": 0.008}, 4.0),
    ],
)
def test_directions(how: dict[str, Any], most: float) -> None:
    eye, ball = camera("left"), BALLS[0]
    lit, _ = picture(eye, list(LIGHTS.values()), **{**how, "full": 0.3})
    (circle,) = [
        c for c in found_balls(lit) if np.hypot(*np.subtract(c, outline(eye, ball))[:2]) < 2
    ]
    assert circle == pytest.approx(outline(eye, ball), abs=0.8)
    pixels, several = highlights(shot(eye, **how), circle) or ({}, -1)
    rays = rays_of(eye, circle, None, 1.0, pixels)
    assert len(rays) >= 4
    assert several == 0
    for ray in rays:
        to = LIGHTS[ray.light] - ball
        to /= np.linalg.norm(to)
        # the ball's own radius changes a direction by up to 1.4°
        assert np.degrees(np.arccos(to @ ray.towards)) < most
        assert 1.0 < np.degrees(ray.error) < 8.0


def test_two_balls_and_cameras_give_positions() -> None:
    eyes = {n: camera(n) for n in EYES}
    circles = {n: [outline(e, b) for b in BALLS] for n, e in eyes.items()}
    circles["right"].reverse()
    balls = group(circles, eyes, None)
    rays = []
    for number, (ball, center, radius) in enumerate(balls):
        assert center == pytest.approx(BALLS[number], abs=1e-3)
        assert radius == pytest.approx(RADIUS, rel=0.01)
        for name, circle in ball.items():
            pixels, _ = highlights(shot(eyes[name]), circle) or ({}, 0)
            rays += rays_of(eyes[name], circle, center, radius, pixels)
    for name in ("led_1", "led_2", "led_3"):
        light = locate([r for r in rays if r.light == name])
        aim = LIGHTS[name] - light.origin
        cosine = float(light.direction @ aim / np.linalg.norm(aim))
        assert np.degrees(np.arccos(cosine)) < 1.0
        if light.distance is not None:
            assert light.distance == pytest.approx(np.linalg.norm(aim), rel=4 * light.unsure)
        at = light.position(1.2)
        assert at is not None
        assert np.linalg.norm(at - LIGHTS[name]) < (0.03 if light.distance is None else 0.3)


def test_a_distance_is_known_by_balls_far_apart() -> None:
    """Exact rays from points 0.3 m apart, with the error that they state."""
    light, points = np.array([0.2, -0.9, 0.5]), np.array([[-0.15, 0, 0], [0.15, 0, 0], [0, 0, 0.2]])
    rng = np.random.default_rng(0)
    rays = []
    for point in points:
        to = light - point + rng.normal(0, 4e-3, 3)
        rays.append(Reflection("a", point, to / np.linalg.norm(to), 5e-3, True))
    found = locate(rays)
    assert found.position(None) == pytest.approx(light, abs=0.05)
    assert 0 < found.unsure < 0.1


def test_what_is_no_single_highlight() -> None:
    eye = camera("left")
    circle = outline(eye, BALLS[0])
    two = {n: picture(eye, [p, LIGHTS["led_2"]], seed=k)
           for k, (n, p) in enumerate(LIGHTS.items()) if n in ("led_1", "led_3")}  # fmt: skip
    assert highlights(two, circle) == ({}, 2)
    assert highlights(shot(eye, matt=True), circle) is None
    assert highlights({n: picture(eye, []) for n in LIGHTS}, circle) is None
    assert highlights({}, circle) is None
    none, _ = picture(eye, [], balls=BALLS[:0])
    assert found_balls(none) == []


def test_a_ball_partly_outside_the_picture() -> None:
    eye = camera("left")
    ball = eye.center + 0.87 * eye.rays(np.array([12.0, 100.0]))  # a third is outside
    lit, _ = picture(eye, list(LIGHTS.values()), balls=ball[None], full=0.3)
    for circle in found_balls(lit):
        assert circle == pytest.approx(outline(eye, ball), abs=0.8)
    images = shot(eye, balls=ball[None])
    pixels, _ = highlights(images, outline(eye, ball)) or ({}, 0)
    rays = rays_of(eye, outline(eye, ball), ball, RADIUS, pixels)
    assert rays
    for ray in rays:
        to = LIGHTS[ray.light] - ray.point
        assert np.degrees(np.arccos(to @ ray.towards / np.linalg.norm(to))) < 3.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("mirror") / "shot"
    cameras = []
    for name in EYES:
        eye = camera(name)
        cameras.append({"id": name, "width": SIZE, "height": SIZE, "K": eye.K.tolist(),
                        "R": eye.R.tolist(), "t": eye.t.tolist()})  # fmt: skip
        for light, (image, _) in shot(eye, full=50.0).items():
            path = root / f"images/{name}/{light}.exr"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_exr(path, np.repeat(image[..., None], 3, axis=2))
    (root / "cameras.json").write_text(json.dumps({"cameras": cameras}))
    return root


def test_lights_of_a_folder_without_any(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = folder.parent / "new"
    command = ["import", str(folder), "--out", str(out), "--dry-run", "--targets"]
    assert main([*command, "--light-distance", "1.2"]) == 0
    said = capsys.readouterr().out
    assert "new-lights.json: 5 lights, for --lights" in said
    assert "[mirror_balls.circles]" in said
    found = {x.name: x.position for x in read_lights(out.parent / "new-lights.json").lights}
    for name, true in LIGHTS.items():
        aim = found[name] / np.linalg.norm(found[name])
        assert np.degrees(np.arccos(aim @ true / 1.2)) < 2.5


@pytest.mark.slow
def test_a_light_that_is_stated_wrongly_is_named(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = folder.parent / "stated"
    command = ["import", str(folder), "--out", str(out), "--dry-run", "--targets"]
    stated = {**LIGHTS, "led_3": LIGHTS["led_0"]}
    entries = [{"name": n, "position": p.tolist()} for n, p in stated.items()]
    (folder.parent / "wrong.json").write_text(json.dumps(entries))
    assert main([*command, "--lights", str(folder.parent / "wrong.json")]) == 0
    said = capsys.readouterr().out
    (worst,) = re.findall(r"off the mirror balls' in the median, led_3 ([0-9.]+)°", said)
    assert float(worst) == pytest.approx(90, abs=6)
    assert "check their positions, order, axes and unit" in said
