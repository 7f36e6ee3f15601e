"""Cameras as others write them, read back: the same pixels, or a sentence that says what to do."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import camera_writers as writers
import cv2
import numpy as np
import pytest

from reconstruction import Camera, write_exr
from reconstruction.files.cameras import CameraFileError, read_cameras
from reconstruction.geometry.lens import Lens
from reconstruction.geometry.lens_models import LensModel, LensModelCamera
from reconstruction.geometry.placement import PlacementOptions, placed, resized

POINTS = np.random.default_rng(3).uniform(-0.12, 0.12, (200, 3))
LENS = np.array([-0.12, 0.03, 2e-3, -1e-3, 0.01])


def stage() -> list[Camera]:
    """Six cameras about the origin, tilted, one upright, half of them through a lens."""
    out = []
    for i in range(6):
        angle = 1.1 * i
        position = [np.cos(angle), np.sin(angle), 0.3 * np.sin(2 * angle)]
        camera = Camera.look_at(f"cam_{i:02d}", 640, 480, position, [0, 0, 0.01], 30, 17.0 * i)
        K = camera.K * [[1, 1, 1], [1, 1.01, 1], [1, 1, 1]] + [[0, 0, 4.2], [0, 0, -7.3], [0, 0, 0]]
        out.append(replace(camera, K=K, distortion=LENS * (i % 2)))
    return out


def assert_same_pixels(found: list[Camera], truth: list[Camera]) -> None:
    by_name = {c.name: c for c in found}
    assert sorted(by_name) == sorted(c.name for c in truth)
    for camera in truth:
        got = by_name[camera.name]
        assert (got.width, got.height) == (camera.width, camera.height)
        expected = cv2.projectPoints(
            POINTS, cv2.Rodrigues(camera.R)[0], camera.t, camera.K, camera.distortion
        )[0][:, 0]
        np.testing.assert_allclose(got.project(POINTS)[0], expected, atol=1e-6)


WRITERS: dict[str, Callable[[Path, list[Camera]], object]] = {
    "sparse": writers.write_colmap_text,
    "binary": writers.write_colmap_binary,
    "transforms.json": writers.write_transforms,
    "cameras.xml": writers.write_metashape,
    "2.xml": lambda path, cameras: writers.write_metashape(path, cameras, component=True),
    "opencv": writers.write_opencv,
    "opencv.json": writers.write_opencv_json,
    "map.json": writers.write_map,
}


@pytest.mark.parametrize("name", WRITERS)
def test_files_of_others_give_the_same_pixels(name: str, tmp_path: Path) -> None:
    WRITERS[name](tmp_path / name, stage())
    assert_same_pixels(read_cameras(tmp_path / name).cameras, stage())


@pytest.mark.parametrize(
    ("kind", "coefficients"),
    [
        ("opencv", [-0.2, 0.1, 1e-3, -2e-3, 0.05, 0.02, -0.03, 0.01]),
        ("opencv", [-0.2, 0.1, 1e-3, -2e-3, 0.05, 0, 0, 0, 1e-3, -2e-3, 3e-3, 1e-3]),
        ("opencv", [-0.1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.02, -0.03]),
        ("fisheye", [0.05, -0.02, 0.01, -0.003]),
    ],
)
def test_lenses_are_opencvs(kind, coefficients) -> None:
    camera = stage()[1]
    found = LensModelCamera(
        "c", 640, 480, camera.K, camera.R, camera.t, lens=LensModel(kind, np.array(coefficients))
    )
    rotation = cv2.Rodrigues(camera.R)[0]
    if kind == "fisheye":
        expected = cv2.fisheye.projectPoints(
            POINTS[:, None], rotation, camera.t, camera.K, np.array(coefficients)
        )[0][:, 0]
    else:
        expected = cv2.projectPoints(POINTS, rotation, camera.t, camera.K, np.array(coefficients))[
            0
        ][:, 0]
    np.testing.assert_allclose(found.project(POINTS)[0], expected, atol=1e-6)
    towards = POINTS - camera.center
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    np.testing.assert_allclose(found.rays(expected), towards, atol=1e-9)


def test_a_picture_through_another_lens_is_resampled_to_a_pinhole() -> None:
    """A straight edge that a fisheye bends is straight again, and where the pinhole sees it."""
    camera = Camera.look_at("c", 160, 120, [0, -1, 0], [0, 0, 0], 60)
    fish = LensModelCamera(
        "c", 160, 120, camera.K, camera.R, camera.t, lens=LensModel("fisheye", np.zeros(0))
    )
    rays = fish.rays(np.stack(np.meshgrid(np.arange(160), np.arange(120)), axis=-1))
    x = rays[..., 0] / rays[..., 1]  # slope to the side, of a wall one metre ahead
    picture = np.repeat((x[..., None] > 0.3).astype(np.float32), 3, axis=2)
    lens = Lens.of(fish)
    straight = lens.undistort(picture)[..., 0]
    edge = (straight < 0.5).sum(axis=1) - 0.5
    expected = lens.undistorted.project(np.add(camera.center, [0.3, 1, 0]))[0][0]
    assert np.abs(edge - expected).max() < 1
    assert lens.undistorted.distortion.tolist() == [0] * 5


def test_a_calib_file_gives_the_same_pixels_in_millimetres(tmp_path: Path) -> None:
    """It counts pixels in shares of the picture's width: scaled to the pictures they are ours."""
    writers.write_calib(tmp_path / "cameras.calib", stage())
    file = read_cameras(tmp_path / "cameras.calib")
    assert file.metres == 0.001
    found = placed(file.cameras, PlacementOptions(unit="mm"), file.axes)
    named = [replace(c, name=f"Cam{i + 1:02d}") for i, c in enumerate(stage())]
    assert_same_pixels([resized(c, 640, 480) for c in found], named)


def test_cameras_not_aligned_by_metashape_give_a_warning(tmp_path: Path) -> None:
    path = tmp_path / "cameras.xml"
    writers.write_metashape(path, stage())
    file = read_cameras(path)
    assert any(note.endswith("not aligned, skipped: lost") for note in file.notes)
    assert file.metres == 1
    good = path.read_text()
    for old, new, words in (
        ("<document", "<documents", "broken XML"),
        ('encoding="UTF-8"', 'encoding="UTF-x"', "broken XML"),
        ('sensor_id="2"', 'sensor_id="22"', "cam_02: there is no sensor '22'"),
        ('label="cam_03">', 'label="cam_03"><transform>1 2 3</transform>', "expected 16 finite"),
        ("LOCAL_CS", "GEOGCS", "geographic coordinates .* local coordinates"),
    ):
        path.write_text(good.replace(old, new))
        with pytest.raises(CameraFileError, match=words):
            read_cameras(path)
    path.write_text(good.replace("<k1>", "<k4>0.01</k4><k1>"))
    assert isinstance(read_cameras(path).cameras[0], LensModelCamera)


def test_files_not_written_by_opencv_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "cam.yml"
    for text, words in (
        ("not: [yaml", "OpenCV cannot read it"),
        ("%YAML:1.0\n---\nwidth: 3\n", "expected one of K, camera_matrix"),
        ('%YAML:1.0\n---\nK: "text"\n', "K must be .* finite numbers"),
        (
            "%YAML:1.0\n---\nK: !!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n  data: [1, 2]\n",
            "K must be .* finite numbers",
        ),
    ):
        path.write_text(text)
        with pytest.raises(CameraFileError, match=words):
            read_cameras(path)


def test_a_camera_alone_and_a_map_without_a_camera_in_json(tmp_path: Path) -> None:
    first, second, *_ = stage()
    path = tmp_path / "cameras.json"
    writers.write_map(path, [first, second])
    data = json.loads(path.read_text())
    data[second.name]["intrinsics"] = data[second.name].pop("K")
    path.write_text(json.dumps(data))
    found = read_cameras(path)
    assert_same_pixels(found.cameras, [first])
    assert [n.endswith(f": {second.name}") for n in found.notes] == [True]
    alone = tmp_path / f"{first.name}.json"
    alone.write_text(json.dumps(data[first.name]))
    assert_same_pixels(read_cameras(alone).cameras, [first])


def test_frames_of_one_pose_are_one_camera(tmp_path: Path) -> None:
    """As files have it that list a frame for each camera and light."""
    path = tmp_path / "transforms.json"
    writers.write_transforms(path, stage())
    data = json.loads(path.read_text())
    data["frames"] = [
        {**frame, "file_path": f"images/{frame['file_path'][7:13]}/{k:03d}.png"}
        for frame in data["frames"]
        for k in range(3)
    ]
    path.write_text(json.dumps(data))
    assert_same_pixels(read_cameras(path).cameras, stage())


def test_the_fourth_radial_number_of_nerfstudio_goes_with_the_eighth_power(tmp_path: Path) -> None:
    """d = 1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸ of nerfstudio's camera_utils; read as OpenCV's
    rational lens, pixels were up to 0.3 off."""
    path, camera = tmp_path / "transforms.json", stage()[1]
    writers.write_transforms(path, [camera])
    data = json.loads(path.read_text())
    data["frames"][0]["k4"] = k4 = 0.05
    path.write_text(json.dumps(data))
    (found,) = read_cameras(path).cameras
    local = POINTS @ camera.R.T + camera.t
    x, y = (local[:, :2] / local[:, 2:]).T
    k1, k2, p1, p2, k3 = camera.distortion
    r = x * x + y * y
    d = 1 + k1 * r + k2 * r**2 + k3 * r**3 + k4 * r**4
    a = x * d + 2 * p1 * x * y + p2 * (r + 2 * x * x)
    b = y * d + 2 * p2 * x * y + p1 * (r + 2 * y * y)
    expected = np.stack([a, b], axis=1) * np.diag(camera.K)[:2] + camera.K[:2, 2]
    np.testing.assert_allclose(found.project(POINTS)[0], expected, atol=1e-6)


@pytest.mark.parametrize("suffix", [".exr", ".tif", ".png"])
def test_pictures_say_how_large_they_are_where_the_file_does_not(suffix, tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    writers.write_transforms(path, stage())
    data = json.loads(path.read_text())
    for frame in data["frames"]:
        del frame["w"], frame["h"]
        frame["file_path"] = frame["file_path"].replace(".png", suffix)
        there = tmp_path / frame["file_path"]
        there.parent.mkdir(exist_ok=True)
        if suffix == ".exr":
            write_exr(there, np.zeros((480, 640, 3), np.float32))
        else:
            cv2.imwrite(str(there), np.zeros((480, 640, 3), np.uint8))
    path.write_text(json.dumps(data))
    assert_same_pixels(read_cameras(path).cameras, stage())


def test_file_errors_name_the_problem(tmp_path: Path) -> None:
    folder = tmp_path / "sparse"
    writers.write_colmap_text(folder, stage())
    images, cameras = folder / "images.txt", folder / "cameras.txt"
    good, lenses = images.read_text(), cameras.read_text()

    def refused(words: str, path: Path = folder) -> None:
        with pytest.raises(CameraFileError, match=words):
            read_cameras(path)

    images.write_text(good.replace(" 12 cam", " 77 cam"))
    refused(r"images\.txt, line 7: no camera 77")
    images.write_text(good.replace("cam_03.jpg", ""))
    refused("line 9: expected IMAGE_ID .* got 9 words")
    images.write_text(good.replace("cam_03.jpg", "cam_02.jpg"))
    refused("image names do not identify cameras")
    images.write_text(good)
    cameras.write_text(lenses.replace("12 FULL_OPENCV 640", "12 FULL_OPENCV 6x40"))
    refused(r"cameras\.txt, line 4: expected a whole number, got '6x40'")
    cameras.write_text(lenses.replace("12 FULL_OPENCV", "12 FOV"))
    refused("FOV has 5 parameters, got 12")
    cameras.unlink()
    refused("no camera file found; expected a COLMAP model")
    refused("no such file", tmp_path / "nowhere")
    binary = tmp_path / "binary"
    writers.write_colmap_binary(binary, stage())
    whole = (binary / "images.bin").read_bytes()
    (binary / "images.bin").write_bytes(whole[:-20])
    refused(r"images\.bin: ends at byte .* is truncated", binary)
    (binary / "images.bin").write_bytes(whole[:83] + b"\xff" * 8 + whole[91:])
    refused(r"images\.bin: .*truncated", binary)
    transforms = tmp_path / "transforms.json"
    writers.write_transforms(transforms, stage())
    data = json.loads(transforms.read_text())
    del data["frames"][2]["w"]
    transforms.write_text(json.dumps(data))
    refused(r"frames\[2\]: .*unknown image size", transforms)
    data["frames"][1]["transform_matrix"] = [[1, 2], [3]]
    transforms.write_text(json.dumps(data))
    refused(r"frames\[1\]\.transform_matrix: expected 4x4", transforms)
