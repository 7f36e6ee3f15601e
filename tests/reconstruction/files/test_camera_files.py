"""Cameras as others write them, read back: the same pixels, or a sentence that says what to do."""

from __future__ import annotations

import json
import re
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
    WRITERS[name](tmp_path / name, writers.stage())
    assert_same_pixels(read_cameras(tmp_path / name).cameras, writers.stage())


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
    camera = writers.stage()[1]
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
    writers.write_calib(tmp_path / "cameras.calib", writers.stage())
    file = read_cameras(tmp_path / "cameras.calib")
    assert file.metres == 0.001
    found = placed(file.cameras, PlacementOptions(unit="mm"), file.axes)
    named = [replace(c, name=f"Cam{i + 1:02d}") for i, c in enumerate(writers.stage())]
    assert_same_pixels([resized(c, 640, 480) for c in found], named)


def test_cameras_not_aligned_by_metashape_give_a_warning(tmp_path: Path) -> None:
    path = tmp_path / "cameras.xml"
    writers.write_metashape(path, writers.stage())
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
    first, second, *_ = writers.stage()
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
    writers.write_transforms(path, writers.stage())
    data = json.loads(path.read_text())
    data["frames"] = [
        {**frame, "file_path": f"images/{frame['file_path'][7:13]}/{k:03d}.png"}
        for frame in data["frames"]
        for k in range(3)
    ]
    path.write_text(json.dumps(data))
    assert_same_pixels(read_cameras(path).cameras, writers.stage())


def test_the_fourth_radial_number_of_nerfstudio_goes_with_the_eighth_power(tmp_path: Path) -> None:
    """d = 1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸ of nerfstudio's camera_utils; read as OpenCV's
    rational lens, pixels were up to 0.3 off."""
    path, camera = tmp_path / "transforms.json", writers.stage()[1]
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
    writers.write_transforms(path, writers.stage())
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
    assert_same_pixels(read_cameras(path).cameras, writers.stage())


def test_file_errors_name_the_problem(tmp_path: Path) -> None:
    folder = tmp_path / "sparse"
    writers.write_colmap_text(folder, writers.stage())
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
    writers.write_colmap_binary(binary, writers.stage())
    whole = (binary / "images.bin").read_bytes()
    (binary / "images.bin").write_bytes(whole[:-20])
    refused(r"images\.bin: ends at byte .* is truncated", binary)
    (binary / "images.bin").write_bytes(whole[:83] + b"\xff" * 8 + whole[91:])
    refused(r"images\.bin: .*truncated", binary)
    transforms = tmp_path / "transforms.json"
    writers.write_transforms(transforms, writers.stage())
    data = json.loads(transforms.read_text())
    del data["frames"][2]["w"]
    transforms.write_text(json.dumps(data))
    refused(r"frames\[2\]: .*unknown image size", transforms)
    data["frames"][1]["transform_matrix"] = [[1, 2], [3]]
    transforms.write_text(json.dumps(data))
    refused(r"frames\[1\]\.transform_matrix: expected 4x4", transforms)


COLMAP_DOC = """# Image list with two lines of data per image:
#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME
#   POINTS2D[] as (X, Y, POINT3D_ID)
# Number of images: 2, mean observations per image: 2
1 0.851773 0.0165051 0.503764 -0.142941 -0.737434 1.02973 3.74354 1 P1180141.JPG
2362.39 248.498 58396 1784.7 268.254 59027 1784.7 268.254 -1
2 0.851773 0.0165051 0.503764 -0.142941 -0.737434 1.02973 3.74354 1 P1180142.JPG
1190.83 663.957 23056 1258.77 640.354 59070
"""
"""The example of COLMAP's documentation (format.rst)."""


def test_the_example_of_colmaps_documentation(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_PINHOLE 3072 2304 2559.81 1536 1152\n")
    (tmp_path / "images.txt").write_text(COLMAP_DOC)
    file = read_cameras(tmp_path)
    assert [c.name for c in file.cameras] == ["P1180141", "P1180142"]
    assert file.notes == []
    w, x, y, z = 0.851773, 0.0165051, 0.503764, -0.142941
    R = file.cameras[0].R
    np.testing.assert_allclose(R[0], [1 - 2 * (y * y + z * z), 2 * (x * y - w * z),
                                      2 * (x * z + w * y)], atol=1e-5)  # fmt: skip
    np.testing.assert_allclose(file.cameras[0].center, -R.T @ [-0.737434, 1.02973, 3.74354])


def test_what_a_colmap_model_lacks_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "sparse"
    writers.write_colmap_text(folder, writers.stage())
    images, cameras = folder / "images.txt", folder / "cameras.txt"
    good = images.read_text()
    images.write_text("# Number of images: 7\n" + good)
    assert "line 1: the file claims 7 images, it has 6" in read_cameras(folder).notes[0]
    images.write_text(good.replace("12.5 3.25 -1", "12.5 3.25 -1 4.0"))
    with pytest.raises(CameraFileError, match="line 6: expected IMAGE_ID"):
        read_cameras(folder)
    images.write_text(good)
    lens = cameras.read_text().splitlines()[1]
    cameras.write_text(f"{cameras.read_text()}99{lens[2:]}\n")
    assert "no image is of the cameras 99" in read_cameras(folder).notes[0]
    cameras.write_text(f"{cameras.read_text()}{lens}\n")
    with pytest.raises(CameraFileError, match="line 9: the camera 10 occurs twice"):
        read_cameras(folder)
    binary = tmp_path / "binary"
    writers.write_colmap_binary(binary, writers.stage())
    with (binary / "images.bin").open("ab") as file:
        file.write(b"left")
    with pytest.raises(CameraFileError, match=r"4 bytes .* belong to no record"):
        read_cameras(binary)


def test_colmaps_fisheyes_of_one_focal_length(tmp_path: Path) -> None:
    """RADIAL_FISHEYE has f, cx, cy, k1, k2 (models.h): θ (1 + k1 θ² + k2 θ⁴)."""
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n")
    (tmp_path / "cameras.txt").write_text("1 RADIAL_FISHEYE 640 480 400 320 240 0.1 0.05\n")
    (camera,) = read_cameras(tmp_path).cameras
    angle = np.arctan(0.3)
    expected = 319.5 + 400 * angle * (1 + 0.1 * angle**2 + 0.05 * angle**4)
    np.testing.assert_allclose(camera.project(np.array([[0.3, 0, 1]]))[0], [[expected, 239.5]])


def test_a_rig_of_metashape_is_component_master_slave(tmp_path: Path) -> None:
    writers.write_rig(tmp_path / "rig.xml", writers.stage())
    assert_same_pixels(read_cameras(tmp_path / "rig.xml").cameras, writers.stage())


@pytest.mark.parametrize(
    ("old", "new", "found", "note"),
    [
        ('<camera id="2"', '<camera enabled="0" id="2"', 5, "disabled, skipped: cam_02"),
        ('component_id="0" master_id="0"\n label="cam_03"', 'label="cam_03"', 5, "not aligned"),
        ("></camera>", "><orientation>6</orientation></camera>", 6, "orientation 6"),
        (
            '<camera id="5" sensor_id="5" component_id="0" master_id="0"\n label="cam_05">',
            '<camera id="5" sensor_id="0" component_id="1" label="cam_05"><transform>1 0 0 0 0 1 0 '
            "0 0 0 1 0 0 0 0 1</transform>",
            5,
            "in another component than 0, without a transform to it, skipped: cam_05",
        ),
    ],
)
def test_what_is_not_used_of_metashape_is_named(old, new, found, note, tmp_path: Path) -> None:
    def change(text: str) -> str:
        assert old in text
        text = text.replace(
            "</component></components>", '</component><component id="1"/></components>'
        )
        return text.replace(old, new)

    writers.write_rig(tmp_path / "rig.xml", writers.stage(), change)
    file = read_cameras(tmp_path / "rig.xml")
    assert len(file.cameras) == found
    assert note in " ".join(file.notes)


@pytest.mark.parametrize("how", ["plain", "by a file", "matrices", "numbers", "no names", "images"])
def test_easymocap(how: str, tmp_path: Path) -> None:
    folder = tmp_path / "calib"
    writers.write_easymocap(
        folder, writers.stage(), vectors=how != "matrices", sizes=how != "images"
    )
    for file in folder.iterdir():
        text = file.read_text()
        if how == "numbers":
            file.write_text(text.replace('"', ""))
        if how == "no names":
            file.write_text("".join(x for x in text.splitlines(True) if "- " not in x[:5]
                                    and "names" not in x))  # fmt: skip
    for i in range(6 if how == "images" else 0):
        (tmp_path / f"images/{i + 1:02d}").mkdir(parents=True)
        cv2.imwrite(str(tmp_path / f"images/{i + 1:02d}/0.png"), np.zeros((480, 640, 3), np.uint8))
    found = read_cameras(folder / "intri.yml" if how == "by a file" else folder)
    assert found.notes == []
    named = [replace(c, name=f"{i + 1:02d}") for i, c in enumerate(writers.stage())]
    for camera, truth in zip(found.cameras, named, strict=True):
        assert camera.name == truth.name
        expected = cv2.projectPoints(
            POINTS, cv2.Rodrigues(truth.R)[0], truth.t, truth.K, truth.distortion
        )[0][:, 0]
        np.testing.assert_allclose(camera.project(POINTS)[0], expected, atol=5e-3)  # six digits


def test_what_easymocap_files_lack_is_named(tmp_path: Path) -> None:
    writers.write_easymocap(tmp_path / "a", writers.stage(), sizes=False)
    with pytest.raises(CameraFileError, match="01: unknown image size: add W_01 and H_01"):
        read_cameras(tmp_path / "a")
    writers.write_easymocap(tmp_path / "b", writers.stage())
    intri, extri = tmp_path / "b/intri.yml", tmp_path / "b/extri.yml"
    intri.write_text(intri.read_text().replace('  - "06"\n', ""))
    file = read_cameras(tmp_path / "b")
    assert len(file.cameras) == 5
    assert "not used: K_06, dist_06, H_06, W_06, R_06, Rot_06, T_06" in file.notes[0]
    extri.write_text(extri.read_text().replace("Rot_02", "Rot_x").replace("Rot_01", "Rot_02"))
    with pytest.raises(CameraFileError, match="02: R and Rot are different rotations"):
        read_cameras(tmp_path / "b")


def test_opencvs_calibration_tutorial(tmp_path: Path) -> None:
    """Its names: Camera_Matrix, Distortion_Coefficients, image_Width, image_Height (XML)."""
    camera = writers.stage()[1]
    storage = cv2.FileStorage(str(tmp_path / "cam_01.xml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_Width", 640)
    storage.write("image_Height", 480)
    storage.write("Camera_Matrix", camera.K)
    storage.write("Distortion_Coefficients", camera.distortion[:, None])
    storage.write("rvec", cv2.Rodrigues(camera.R)[0])
    storage.write("tvec", camera.t[:, None])
    storage.release()
    assert_same_pixels(read_cameras(tmp_path / "cam_01.xml").cameras, [camera])


def test_a_lens_is_what_any_of_its_names_says(tmp_path: Path) -> None:
    """`fisheye_model` of OpenCV's calibration program, kalibr's pair of names, an unknown lens."""
    writers.write_map(tmp_path / "a.json", writers.stage()[1:2])
    data = json.loads((tmp_path / "a.json").read_text())

    def read(**fields: object) -> Camera:
        (name,) = data
        table = {**data[name], "dist": [0.1, 0.01, 0, 0], **fields}
        (tmp_path / "b.json").write_text(json.dumps({name: table}))
        return read_cameras(tmp_path / "b.json").cameras[0]

    fisheyes = [
        {"fisheye_model": 1},
        {"camera_model": "pinhole", "distortion_model": "equidistant"},
    ]
    for fields in fisheyes:
        found = read(**fields)
        assert isinstance(found, LensModelCamera)
        assert found.lens.kind == "fisheye"
    assert read(distortion_model="plumb_bob").distortion.tolist() == [0.1, 0.01, 0, 0, 0]
    with pytest.raises(CameraFileError, match="the lens model 'division' is not OpenCV's"):
        read(model="division")


@pytest.mark.parametrize(
    ("change", "note"),
    [
        (lambda d: d.update(applied_transform=np.eye(4)[:3].tolist()), "applied_transform"),
        (
            lambda d: d.update(fl_x=1.0),
            r"frames\[0\]: its own fl_x .* \(all frames: 1.0\) are used",
        ),
        (lambda d: d["frames"][0].update(mask_path="m.png"), "1 frames have a mask_path, not used"),
        (lambda d: d.update(ply_file_path="sparse_pc.ply", aabb_scale=16), "^$"),
    ],
)
def test_what_nerfstudio_adds_is_named(change, note: str, tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    writers.write_transforms(path, writers.stage())
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    file = read_cameras(path)
    assert_same_pixels(file.cameras, writers.stage())
    assert re.search(note, " ".join(file.notes[:1]))


def test_fields_of_view_and_a_transposed_matrix_of_nerfstudio(tmp_path: Path) -> None:
    """Half of 640 over tan 0.3 is 1034.5; half of 480 over tan 0.2 is 1184.0."""
    path = tmp_path / "transforms.json"
    writers.write_transforms(path, writers.stage())
    data = json.loads(path.read_text())
    for frame in data["frames"]:
        del frame["fl_x"], frame["fl_y"]
    data |= {"camera_angle_x": 0.6, "camera_angle_y": 0.4}
    path.write_text(json.dumps(data))
    K = read_cameras(path).cameras[0].K
    assert (K[0, 0], K[1, 1]) == pytest.approx((1034.4725, 1183.9569), rel=1e-6)
    frame = data["frames"][1]
    frame["transform_matrix"] = np.transpose(frame["transform_matrix"]).tolist()
    path.write_text(json.dumps(data))
    with pytest.raises(
        CameraFileError, match=r"frames\[1\]\.transform_matrix: expected a last row"
    ):
        read_cameras(path)
