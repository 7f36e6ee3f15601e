"""Charts and balls of known colours and outlines; the sRGB values are X-Rite's."""

import json

import cv2
import numpy as np
import pytest

from reconstruction import import_folder, write_exr
from reconstruction.capture.import_folder import Import, settings_of
from reconstruction.images.colour_chart import PUBLISHED, find_balls, find_chart
from reconstruction.images.import_targets import find_targets

CAST = np.array([0.6, 1.0, 0.8])


def drawn(angle=0.0, wide=300, cast=CAST, shadow=False, noise=0.003, seed=0):
    """A chart `wide` pixels across, turned by `angle` degrees, in a cluttered image (480, 640)."""
    code = np.array(PUBLISHED).reshape(4, 6, 3) / 255
    colours = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    chart = np.full((290, 430, 3), 0.01)
    for row, column in np.ndindex(4, 6):
        y, x = 10 + 70 * row, 10 + 70 * column
        chart[y : y + 60, x : x + 60] = colours[row, column]
    rng = np.random.default_rng(seed)
    clutter = 0.05 + 0.05 * np.kron(rng.uniform(size=(12, 16)), np.ones((40, 40)))
    M = cv2.getRotationMatrix2D((215, 145), -angle, wide / 430)
    M[:, 2] += (320 - 215, 240 - 145)
    image = np.repeat(clutter[..., None], 3, axis=2)
    cv2.warpAffine(chart, M, (640, 480), image, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT)
    if shadow:
        image[:, 300:] *= 0.4
    return (image * cast + rng.normal(0, noise, image.shape)).astype(np.float32)


@pytest.mark.parametrize(
    ("angle", "wide", "shadow"),
    [(0, 430, False), (20, 200, True), (45, 130, False), (90, 100, True), (200, 90, False)],
)
def test_white_balance_within_two_percent(angle, wide, shadow) -> None:
    chart = find_chart(drawn(angle, wide, shadow=shadow))
    assert chart is not None
    np.testing.assert_allclose(chart.white_balance * CAST, 1.0, rtol=0.02)
    assert chart.error < 0.02


def test_no_chart() -> None:
    rng = np.random.default_rng(0)
    board = np.kron(np.indices((8, 12)).sum(axis=0) % 2, np.ones((50, 50)))
    grid = np.stack([np.kron(rng.uniform(size=(4, 6)), np.ones((60, 60))) for _ in range(3)], -1)
    for image in (board[..., None].repeat(3, 2), grid, np.zeros((90, 120, 3))):
        assert find_chart(image.astype(np.float32)) is None
    assert find_chart(drawn(), np.ones((480, 640), bool)) is None  # saturated


def ball(x, y, radius, seed=0):
    """A matt ball lit from above in front of clutter."""
    rows, columns = np.indices((480, 640))
    depth = radius**2 - (columns - x) ** 2 - (rows - y) ** 2
    normal = np.stack([columns - x, rows - y, np.sqrt(np.maximum(depth, 0))], axis=-1) / radius
    shade = 0.18 * (0.3 + 0.7 * np.maximum(normal @ (0.3, -0.4, 0.86), 0))
    rng = np.random.default_rng(seed)
    image = np.where(depth > 0, shade, np.kron(rng.uniform(0, 0.03, (12, 16)), np.ones((40, 40))))
    image = cv2.GaussianBlur(image, (0, 0), 0.7) + rng.normal(0, 0.002, image.shape)
    return image[..., None].repeat(3, 2).astype(np.float32)


@pytest.mark.parametrize("circle", [(200.3, 180.8, 15.4), (420.7, 250.2, 36.0), (300, 240, 87.3)])
def test_a_ball_within_a_pixel(circle) -> None:
    np.testing.assert_allclose(find_balls(ball(*circle)), [circle], atol=1.0)


def test_no_ball() -> None:
    assert find_balls(np.zeros((90, 120, 3), np.float32)) == []
    assert find_balls(drawn(noise=0.0)) == []


def test_targets_of_a_folder_become_its_settings(tmp_path) -> None:
    """Their lines for import.toml make the chart neutral; without targets two sentences."""
    folder, names = tmp_path / "in", ("cam_0", "cam_1")
    folder.mkdir()
    K = [[900, 0, 319.5], [0, 900, 239.5], [0, 0, 1]]
    poses = ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 1, 0], [0, 0, -1], [-1, 0, 0]])
    cameras = [
        {"id": n, "width": 640, "height": 480, "K": K, "R": R, "t": [0, 0, 1]}
        for n, R in zip(names, poses, strict=True)
    ]
    (folder / "cameras.json").write_text(json.dumps({"cameras": cameras}))
    light = {"id": "a", "position": [0, -1, 1], "intensity": [1, 1, 1]}
    (folder / "lights.json").write_text(json.dumps({"lights": [light]}))
    for name in names:
        (folder / "images" / name).mkdir(parents=True)
        image = drawn(wide=200)
        image[:240, :320] = ball(160.5, 120.5, 50)[:240, :320]
        write_exr(folder / "images" / name / "a.exr", image)
    found = find_targets(Import.of(folder), tmp_path / "proof.png")
    assert cv2.imread(str(tmp_path / "proof.png")).shape == (360, 960, 3)
    assert "red x 1.66" in found.notes[0]
    assert "albedo" in found.toml
    (folder / "import.toml").write_text(found.toml.partition("[grey_ball]")[0])
    assert settings_of(folder).sensor.matrix is not None
    image = import_folder(folder, tmp_path / "out").light("a", "cam_0")[0]
    np.testing.assert_allclose(find_chart(image).white_balance, 1.0, rtol=0.02)
    for name in names:
        write_exr(folder / "images" / name / "a.exr", np.full((480, 640, 3), 0.1, np.float32))
    nothing = find_targets(Import.of(folder), tmp_path / "none.png")
    assert nothing.toml == ""
    assert "no chart" in nothing.notes[0]
    assert "in no camera" in nothing.notes[1]
