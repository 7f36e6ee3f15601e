"""Camera files that others write in further ways: COLMAP's models, OpenCV's YAML."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import camera_writers as writers
import cv2
import numpy as np
import pytest

from reconstruction import Camera
from reconstruction.files.cameras import CameraFileError, read_cameras

POINTS = np.random.default_rng(3).uniform(-0.12, 0.12, (50, 3)) + np.array([0, 0, 1])


def radial(r2: Any, *k: float) -> Any:
    return sum(c * r2 ** (i + 1) for i, c in enumerate(k))


def by_models_h(model: str, p: list[float]) -> np.ndarray:
    """Pixels, the corner of the first at 0, as COLMAP's `sensor/models.h` has each model."""
    u, v = (POINTS[:, :2] / POINTS[:, 2:]).T
    single = model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL") or (
        model in ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
    )
    focal, rest = ((p[0], p[0]), p[1:]) if single else ((p[0], p[1]), p[2:])
    (cx, cy), k = rest[:2], rest[2:]
    if "FISHEYE" in model:
        r = np.hypot(u, v)
        angle = np.arctan(r)
        scale = angle * (1 + radial(angle**2, *k)) / r
        u, v = u * scale, v * scale
    elif model in ("SIMPLE_RADIAL", "RADIAL"):
        scale = 1 + radial(u * u + v * v, *k)
        u, v = u * scale, v * scale
    elif model in ("OPENCV", "FULL_OPENCV"):
        r2, (k1, k2, p1, p2, *more) = u * u + v * v, k
        k3, *below = more or [0.0]
        scale = (1 + radial(r2, k1, k2, k3)) / (1 + radial(r2, *below))
        u, v = (
            u * scale + 2 * p1 * u * v + p2 * (r2 + 2 * u * u),
            v * scale + 2 * p2 * u * v + p1 * (r2 + 2 * v * v),
        )
    return np.stack([focal[0] * u + cx, focal[1] * v + cy], axis=1)


TWO, LENS = [800.0, 790.0, 322.0, 239.0], [-0.12, 0.03, 2e-3, -1e-3]
ONE = [800.0, 322.0, 239.0]
MODELS = {
    "SIMPLE_PINHOLE": (0, ONE),
    "PINHOLE": (1, TWO),
    "SIMPLE_RADIAL": (2, [*ONE, -0.12]),
    "RADIAL": (3, [*ONE, -0.12, 0.03]),
    "OPENCV": (4, [*TWO, *LENS]),
    "OPENCV_FISHEYE": (5, [*TWO, 0.1, -0.02, 0.01, 0.003]),
    "FULL_OPENCV": (6, [*TWO, *LENS, 0.01, 0.02, -0.03, 0.01]),
    "SIMPLE_RADIAL_FISHEYE": (8, [*ONE, 0.1]),
    "RADIAL_FISHEYE": (9, [*ONE, 0.1, 0.05]),
}
"""Numbers and parameters, by `sensor/models.h`."""
IMAGE = (1.0, 0, 0, 0, 0, 0, 0)


def colmap(folder: Path, model: str, kind: str, params: list[float], number: int) -> Path:
    """A model of one image, by COLMAP's "Output Format"; 3.12 writes rigs and frames too."""
    folder.mkdir()
    if kind == "text":
        words = " ".join(map(repr, params))
        (folder / "cameras.txt").write_text(f"7 {model} 640 480 {words}\n")
        (folder / "images.txt").write_text(f"3 {' '.join(map(str, IMAGE))} 7 a.png\n\n")
        (folder / "rigs.txt").write_text("1 1 CAMERA 7\n")
        (folder / "frames.txt").write_text(f"1 1 {' '.join(map(str, IMAGE))} 1 CAMERA 7 3\n")
    else:
        head = struct.pack("<QiiQQ", 1, 7, number, 640, 480)
        (folder / "cameras.bin").write_bytes(head + struct.pack(f"<{len(params)}d", *params))
        image = struct.pack("<Qi7di", 1, 3, *IMAGE, 7) + b"a.png\0"
        points = struct.pack("<Qddq", 1, 12.5, 3.25, (1 << 64) // 2 - 1)
        (folder / "images.bin").write_bytes(image + points)
        (folder / "rigs.bin").write_bytes(struct.pack("<Q", 0))
    return folder


@pytest.mark.parametrize("kind", ["text", "binary"])
@pytest.mark.parametrize("model", MODELS)
def test_colmaps_models_project_as_its_own_code(model: str, kind: str, tmp_path: Path) -> None:
    number, params = MODELS[model]
    (camera,) = read_cameras(colmap(tmp_path / "m", model, kind, params, number)).cameras
    assert (camera.name, camera.width, camera.height) == ("a", 640, 480)
    expected = by_models_h(model, params) - 0.5
    np.testing.assert_allclose(camera.project(POINTS)[0], expected, atol=1e-6)


@pytest.mark.parametrize("kind", ["text", "binary"])
@pytest.mark.parametrize(
    ("model", "number", "count"),
    [("FOV", 7, 5), ("THIN_PRISM_FISHEYE", 10, 12), ("RAD_TAN_THIN_PRISM_FISHEYE", 11, 16)],
)
def test_models_without_a_lens_of_opencvs_are_refused(model, number, count, kind, tmp_path) -> None:
    folder = colmap(tmp_path / "m", model, kind, [*TWO, *[0.1] * (count - 4)], number)
    with pytest.raises(CameraFileError, match=f"lens model {model}: .*image_undistorter"):
        read_cameras(folder)


def test_a_model_that_is_not_known_is_refused(tmp_path: Path) -> None:
    for kind in ("text", "binary"):
        folder = colmap(tmp_path / kind, "DIVISION", kind, TWO, 17)
        with pytest.raises(CameraFileError, match=r"the camera model .* is unknown"):
            read_cameras(folder)


def yaml(camera: Camera, head: str = "%YAML:1.0\n---\n", kind: str = "!!opencv-matrix\n") -> str:
    """As `cv::FileStorage` writes it; ROS has no tags and no `dt`."""

    def matrix(values: Any, rows: int) -> str:
        flat = np.asarray(values, float).ravel()
        numbers = ", ".join(repr(float(v)) for v in flat)
        dt = "   dt: d\n" if kind.strip() else ""
        return f"{kind}   rows: {rows}\n   cols: {len(flat) // rows}\n{dt}   data: [ {numbers} ]\n"

    return head + (
        f"image_width: {camera.width}\nimage_height: {camera.height}\n"
        f"camera_matrix: {matrix(camera.K, 3)}"
        f"distortion_coefficients: {matrix(camera.distortion, 1)}"
        f"R: {matrix(camera.R, 3)}T: {matrix(camera.t, 3)}"
    )


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("cam_01.yml", str),
        ("cam_01.yaml", lambda t: t.replace("\n", "\r\n")),
        ("cam_01.yml", lambda t: t.replace("dt: d", "dt: f")),
        ("cam_01.yml", lambda t: t.replace("---\n", "---\n# by hand\n")),
        ("cam_01.yml", lambda t: t.replace("rows: 1\n   cols: 5", "sizes: [ 1, 5 ]")),
        ("cam_01.yml", lambda t: t.replace("distortion_coefficients", "D")),
        ("cam_01.yml", lambda t: t + "distortion_model: plumb_bob\navg_reprojection_error: 0.2\n"),
    ],
)
def test_yaml_of_opencv_in_other_hands(name: str, change: Any, tmp_path: Path) -> None:
    camera = writers.stage()[1]
    (tmp_path / name).write_bytes(change(yaml(camera)).encode())
    (found,) = read_cameras(tmp_path / name).cameras
    points = POINTS - (0, 0, 1)
    turn = cv2.Rodrigues(camera.R)[0]
    expected = cv2.projectPoints(points, turn, camera.t, camera.K, camera.distortion)[0][:, 0]
    np.testing.assert_allclose(found.project(points)[0], expected, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t.replace("   cols: 5", "   cols: 6"), "distortion_coefficients must be"),
        (lambda t: t.replace("R: ", "S: "), "no pose: give R"),
        (lambda t: t.replace("image_width: 640", "image_width: 640.5"), r"image_width .* whole"),
        (lambda t: t[:200], "OpenCV cannot read it"),
    ],
)
def test_yaml_that_is_not_clear_is_refused(change: Any, words: str, tmp_path: Path) -> None:
    path = tmp_path / "cam_01.yml"
    path.write_text(change(yaml(writers.stage()[1])))
    with pytest.raises(CameraFileError, match=rf"cam_01\.yml: {words}"):
        read_cameras(path)
