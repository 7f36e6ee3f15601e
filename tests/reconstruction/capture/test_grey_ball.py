"""W/(sr m²) from a grey ball, on pictures of one that are made ray by ray here."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from reconstruction import import_folder
from reconstruction.capture.grey_ball import DISAGREE
from reconstruction.capture.import_folder import ImportProblem

SIZE, FOCAL = 120, 260.0
BALL, RADIUS, ALBEDO = np.array([0.06, 0.02, -0.01]), 0.03, 0.18
FULL = 0.37
"""W/(sr m²) of a full channel at 1 s, which the import is not told."""
EYES = {"left": [-0.5, -0.8, 0.1], "right": [0.6, -0.7, 0.0], "top": [0.1, -0.6, 0.7]}
LIGHTS = {f"light_{i:03d}": [1.3 * np.cos(a), 1.3 * np.sin(a), 0.4] for i, a in
          enumerate(np.linspace(-2.6, -0.5, 7))}  # fmt: skip
INTENSITY = np.array([4.0, 3.0, 2.0])


def pose(eye):
    """World to camera, z ahead and y down, looking at the origin."""
    ahead = -np.array(eye) / np.linalg.norm(eye)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    R = np.array([right, np.cross(ahead, right), ahead])
    return R, -R @ np.array(eye)


def picture(eye, light):
    """Radiance `(H, W, 3)` of the ball before a faint wall."""
    R, _ = pose(eye)
    y, x = np.mgrid[:SIZE, :SIZE].astype(float)
    middle = (SIZE - 1) / 2
    d = np.stack([(x - middle) / FOCAL, (y - middle) / FOCAL, np.ones_like(x)], -1) @ R
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    to = BALL - eye
    along = d @ to
    inside = RADIUS**2 - (to @ to - along**2)
    hit = np.array(eye) + (along - np.sqrt(np.maximum(inside, 0)))[..., None] * d
    normal = (hit - BALL) / RADIUS
    towards = np.array(light) - hit
    squared = (towards**2).sum(-1)
    cosine = np.maximum((normal * towards).sum(-1) / np.sqrt(squared), 0)
    shade = ALBEDO / np.pi * cosine / squared
    return np.where(inside > 0, shade, 0.002)[..., None] * INTENSITY


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "shot"
    cameras, circles = [], {}
    for name, eye in EYES.items():
        R, t = pose(eye)
        middle = (SIZE - 1) / 2
        K = [[FOCAL, 0, middle], [0, FOCAL, middle], [0, 0, 1]]
        size = {"width": SIZE, "height": SIZE, "K": K}
        cameras.append({"id": name, **size, "R": R.tolist(), "t": t.tolist()})
        x, y, z = R @ BALL + t
        circles[name] = [FOCAL * x / z + middle, FOCAL * y / z + middle, FOCAL * RADIUS / z]
        for light, place in LIGHTS.items():
            path = root / f"images/{name}/{light}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            counts = np.round(65535 * picture(eye, place) / FULL).astype(np.uint16)
            assert cv2.imwrite(str(path), counts[..., ::-1])
    (root / "cameras.json").write_text(json.dumps({"cameras": cameras}))
    lights = [
        {"id": n, "position": list(p), "intensity": INTENSITY.tolist()} for n, p in LIGHTS.items()
    ]
    (root / "lights.json").write_text(json.dumps({"lights": lights}))
    write_settings(root, circles)
    return root


def write_settings(root, circles, more=""):
    lines = [f"{name} = {[round(float(v), 2) for v in c]}" for name, c in circles.items()]
    text = f"{more}\n[grey_ball]\nalbedo = {ALBEDO}\n[grey_ball.circles]\n"
    (root / "import.toml").write_text(text + "\n".join(lines))
    return circles


def circle_settings(root):
    return {
        line.partition(" = ")[0]: json.loads(line.partition(" = ")[2])
        for line in (root / "import.toml").read_text().splitlines()
        if line.partition(" ")[0] in EYES
    }


def test_radiance_is_the_balls(folder, tmp_path):
    capture = import_folder(folder, tmp_path / "out")
    for camera, light in (("left", "light_000"), ("top", "light_003"), ("right", "light_006")):
        image, _ = capture.light(light, camera)
        truth = picture(EYES[camera], LIGHTS[light])
        assert image.sum() == pytest.approx(truth.sum(), rel=0.02)
    said = capture.plan["import"]
    assert not said["relative"]
    _, note = said["notes"]
    assert note.startswith("grey ball: radius 30 mm at (0.060, 0.020, -0.010) m")


def test_a_light_that_something_stands_before_changes_nothing(folder, tmp_path):
    for name in EYES:
        path = folder / f"images/{name}/light_002.png"
        assert cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED) // 8)
    capture = import_folder(folder, tmp_path / "out")
    image, _ = capture.light("light_004", "left")
    truth = picture(EYES["left"], LIGHTS["light_004"])
    assert image.sum() == pytest.approx(truth.sum(), rel=0.02)


def test_contradicting_lights_and_a_coloured_ball_give_warnings(folder, tmp_path):
    for k, light in enumerate(LIGHTS):
        for name in EYES:
            path = folder / f"images/{name}/{light}.png"
            counts = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) * np.array([0.8, 1.0, 1.0])
            assert cv2.imwrite(str(path), (counts / (1 + k % 3)).astype(np.uint16))
    notes = import_folder(folder, tmp_path / "out").plan["import"]["notes"]
    assert DISAGREE < 0.5
    assert any("frames disagree by" in n for n in notes)
    assert any("images are coloured" in n and n.count("1.") == 1 for n in notes), notes


@pytest.mark.parametrize(
    ("change", "more", "words"),
    [
        ({"left": [30.0, 90.0, 8.0]}, "", "circles: the ray of .* misses the ball by"),
        ({"back": [60.0, 60.0, 8.0]}, "", "circles: no camera 'back'"),
        ({"left": None, "top": None}, "", "outline in two cameras or more"),
        ({"left": [60.0, 60.0, -8.0]}, "", "a positive radius"),
        ({}, "scale = 2.0", "remove `units` and `scale`"),
    ],
)
def test_an_invalid_grey_ball_raises_an_error(folder, tmp_path, change, more, words):
    circles = {k: v for k, v in {**circle_settings(folder), **change}.items() if v is not None}
    write_settings(folder, circles, more)
    with pytest.raises(ImportProblem, match=f"grey_ball.*{words}"):
        import_folder(folder, tmp_path / "out")


def test_an_unlit_ball_raises_an_error(folder, tmp_path):
    for path in folder.glob("images/*/*.png"):
        assert cv2.imwrite(str(path), np.zeros((SIZE, SIZE, 3), np.uint16))
    with pytest.raises(ImportProblem, match="no frame shows the lit side of the ball"):
        import_folder(folder, tmp_path / "out")
