"""Captures made elsewhere, whole and broken."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from reconstruction import Capture, CaptureError, import_folder, read_exr, verify, write_exr
from reconstruction.capture.import_folder import ImportProblem
from reconstruction.capture.import_geometry import GeometryFiles, read_geometry
from reconstruction.geometry.placement import PlacementError, PlacementOptions

CAMERAS = ("cam_00", "left")
LIGHTS = ("light_00", "light_07")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two cameras and two lights; picture (i, j) is all 10 i + j."""
    root = tmp_path / "elsewhere"
    K = [[50, 0, 3.5], [0, 50, 2.5], [0, 0, 1]]
    cameras = [
        {
            "id": i,
            "width": 8,
            "height": 6,
            "K": K,
            "R": np.eye(3).tolist(),
            "t": [0, 0, 1 + n],
            "center": [0, 0, -1 - n],
        }
        for n, i in enumerate((0, "left"))
    ]
    lights = [
        {"id": 0, "position": [0, 0, -1], "intensity": [1, 2, 3], "colocated_camera": "left"},
        {"id": 7, "position": [0, 1, 0], "intensity": [1, 1, 1], "colocated_camera": None},
    ]
    units = {"position": "m", "intensity": "W/sr"}
    for i, camera in enumerate(CAMERAS):
        (root / "images" / camera).mkdir(parents=True)
        for j, light in enumerate(LIGHTS):
            image = np.full((6, 8, 3), 10 * i + j, np.float32)
            write_exr(root / "images" / camera / f"{light}.exr", image)
    (root / "masks").mkdir()
    mask = np.zeros((6, 8), np.uint8)
    mask[2:4] = 128
    cv2.imwrite(str(root / "masks" / "left.png"), mask)
    (root / "cameras.json").write_text(json.dumps({"cameras": cameras}))
    (root / "lights.json").write_text(json.dumps({"units": units, "lights": lights}))
    return root


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def test_lenses_are_imported(folder: Path, tmp_path: Path) -> None:
    lens = [-0.1, 0.02, 1e-3, 0, 0]
    edit(folder / "cameras.json", lambda d: d["cameras"][1].update(distortion=lens))
    capture = import_folder(folder, tmp_path / "out", lambda _, share: None)
    straight, bent = capture.rig.cameras
    assert not straight.distorted
    assert bent.distortion.tolist() == lens


def test_becomes_a_capture(folder: Path, tmp_path: Path) -> None:
    shares: list[float] = []
    capture = import_folder(folder, tmp_path / "out", lambda _, share: shares.append(share))
    assert verify(tmp_path / "out") == []
    assert [c.name for c in capture.rig.cameras] == list(CAMERAS)
    assert capture.olat_lights() == list(LIGHTS)
    assert capture.olat("left")[0][:, 0, 0, 0].tolist() == [10, 11]
    assert [light.beside for light in capture.rig.lights] == ["left", None]
    mask = capture.mask("left")
    assert mask is not None
    assert mask.sum() == 16
    assert capture.mask("cam_00") is None
    assert capture.head is None
    assert capture.manifest is not None
    assert shares == [0.25, 0.5, 0.75, 1.0]


@pytest.mark.parametrize(
    ("file", "change", "words"),
    [
        ("cameras.json", lambda d: d.pop("cameras"), "the field 'cameras' is missing"),
        ("cameras.json", lambda d: d.update(cameras=[]), "cameras: expected a list"),
        ("cameras.json", lambda d: d.update(cameras=[3]), r"cameras\[0\]: expected an object"),
        ("cameras.json", lambda d: d["cameras"][1].pop("K"), r"cameras\[1\]: the field 'K'"),
        ("cameras.json", lambda d: d["cameras"][0].update(t=[1, 2]), r"cameras\[0\]\.t: expected"),
        ("cameras.json", lambda d: d["cameras"][0].update(t="abc"), r"cameras\[0\]\.t: expected"),
        (
            "cameras.json",
            lambda d: d["cameras"][0].update(distortion=[1]),
            r"\.distortion: expected",
        ),
        (
            "cameras.json",
            lambda d: d["cameras"][0].update(distortion=[-999, 0, 0, 0, 0]),
            r"cameras\[0\]: .*folds over",
        ),
        ("cameras.json", lambda d: d["cameras"][0].update(width=8.5), r"\.width: expected a whole"),
        (
            "cameras.json",
            lambda d: d["cameras"][0].update(R=(2 * np.eye(3)).tolist()),
            "R is not a rotation",
        ),
        (
            "cameras.json",
            lambda d: d["cameras"][0].update(center=[0, 0, 1]),
            r"cameras\[0\]\.center: .* is not -Rᵀt",
        ),
        (  # MATLAB's IntrinsicMatrix
            "cameras.json",
            lambda d: d["cameras"][0].update(K=[[50, 0, 0], [0, 50, 0], [3.5, 2.5, 1]]),
            r"cameras\[0\]: cam_00: K must be .* is it transposed",
        ),
        (
            "cameras.json",
            lambda d: d["cameras"][0].update(K=[[100, 0, 7], [0, 100, 5], [0, 0, 2]]),
            r"cameras\[0\]: cam_00: K must be .* or scaled",
        ),
        ("cameras.json", lambda d: d["cameras"][1].update(id=0), r"cameras\[1\]\.id: duplicate 0"),
        (
            "cameras.json",
            lambda d: d["cameras"][1].update(id="../x"),
            r"cameras\[1\]\.id: expected",
        ),
        ("lights.json", lambda d: d["lights"][0].pop("intensity"), r"lights\[0\]: the field"),
        (
            "lights.json",
            lambda d: d["lights"][0].update(intensity=[-1, 0, 0]),
            r"lights\[0\]\.intensity: must not be negative",
        ),
        (
            "lights.json",
            lambda d: d["lights"][0].update(colocated_camera=5),
            r"lights\[0\]\.colocated_camera: no camera has the id 5",
        ),
        ("lights.json", lambda d: d["units"].update(position="cm"), r"units\.position: expected"),
    ],
)
def test_wrong_fields_are_named(
    folder: Path, tmp_path: Path, file: str, change: Callable[[Any], object], words: str
) -> None:
    edit(folder / file, change)
    with pytest.raises(ImportProblem, match=rf"{file}: .*{words}|{file}: {words}"):
        import_folder(folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("file", ["cameras.json", "lights.json"])
def test_absent_and_broken_files_are_named(folder: Path, tmp_path: Path, file: str) -> None:
    (folder / file).write_bytes(b"{ nothing")
    with pytest.raises(ImportProblem, match=file):
        import_folder(folder, tmp_path / "out")
    (folder / file).unlink()
    absent = rf"{file}: no such file|or lights \({file}, --lights\)"
    with pytest.raises(ImportProblem, match=absent):
        import_folder(folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_wrong_pictures(folder: Path, tmp_path: Path) -> None:
    path = folder / "images" / "left" / "light_07.exr"
    write_exr(path, np.zeros((8, 6, 3), np.float32))
    with pytest.raises(ImportProblem, match=r"light_07\.exr: 6x8 pixels, expected 8x6"):
        import_folder(folder, tmp_path / "out")
    write_exr(path, np.full((6, 8, 3), np.nan, np.float32))
    with pytest.raises(ImportProblem, match=r"light_07\.exr: 144 values are not finite"):
        import_folder(folder, tmp_path / "out")
    cv2.imwrite(str(folder / "masks" / "left.png"), np.zeros((3, 3), np.uint8))
    with pytest.raises(ImportProblem, match=r"left\.png: expected a PNG"):
        import_folder(folder, tmp_path / "out")
    cv2.imwrite(str(folder / "masks" / "left.png"), np.ones((6, 8), np.uint8))
    with pytest.raises(ImportProblem, match=r"left\.png: is empty: .* brightest pixel is 1"):
        import_folder(folder, tmp_path / "out")
    cut_out = np.full((6, 8, 4), 255, np.uint8)
    cut_out[:, 4:, 3] = 0  # white under a transparent background
    cv2.imwrite(str(folder / "masks" / "left.png"), cut_out)
    with pytest.raises(ImportProblem, match=r"left\.png: is 50% opaque, but 100%"):
        import_folder(folder, tmp_path / "out")
    (folder / "head.obj").write_text("v 0 0 0\n")
    (folder / "masks" / "left.png").unlink()
    with pytest.raises(ImportProblem, match=r"head\.obj: no faces"):
        import_folder(folder, tmp_path / "out")


def test_files_in_other_units_than_metres_are_named(folder: Path, tmp_path: Path) -> None:
    def refused(words: str) -> None:
        with pytest.raises(ImportProblem, match=f"{words}.*give (metres with z up|--unit)"):
            import_folder(folder, tmp_path / "out")

    def scaled(kind: str, field: str, by: float) -> None:
        edit(
            folder / f"{kind}.json",
            lambda d: [x.update({field: [by * v for v in x[field]]}) for x in d[kind]],
        )

    def turned(data: dict[str, Any]) -> None:
        for entry in data["cameras"]:
            del entry["center"]
        data["cameras"][1]["R"] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]

    edit(folder / "cameras.json", turned)  # both look at the origin
    scaled("cameras", "t", 1000)
    refused(r"cameras\.json: the cameras are 1\.5 km from the point")
    scaled("cameras", "t", 1e-3)
    scaled("lights", "position", 1000)
    refused(r"lights\.json: the lights are 1 km")
    scaled("lights", "position", 1e-3)
    corners = "v 0 0 0\nv 180 0 0\nv 0 230 0\n"
    (folder / "head.obj").write_text(corners + "f 1 2 3\n")
    refused(r"head\.obj: is 230 m wide")
    (folder / "head.obj").unlink()
    (folder / "scalp.obj").write_text(corners)
    refused(r"scalp\.obj: is 230 m wide")
    (folder / "scalp.obj").unlink()
    import_folder(folder, tmp_path / "out")


def colmap_model(folder: Path) -> Path:
    """Two cameras 1,000 mm from the origin, at right angles, of twice the pictures' size."""
    sparse = folder / "sparse"
    sparse.mkdir()
    (sparse / "cameras.txt").write_text("3 PINHOLE 16 12 100 100 8 6\n")
    images = ["1 1 0 0 0 0 0 1000 3 cam_00/all.jpg", "", "2 1 0 1 0 10 0 1000 3 left/all.jpg", ""]
    (sparse / "images.txt").write_text("\n".join(images))
    return sparse


@pytest.mark.parametrize("pictures", ["0 7", "00 07", "Light_000 Light-07", "light_0 light_007"])
@pytest.mark.parametrize("ids", ["0 7", "00 07", "light_00 light_07", "0.0 7.0"])
def test_lights_of_a_table_are_matched_to_the_pictures_by_number(
    folder: Path, tmp_path: Path, pictures: str, ids: str
) -> None:
    """And placed by the unit in the table's header, whatever that of the cameras is."""
    for camera, (old, new) in product(CAMERAS, zip(LIGHTS, pictures.split(), strict=True)):
        file = folder / "images" / camera / f"{old}.exr"
        file.rename(file.with_name(f"{new}.exr"))
    first, second = ids.split()
    (folder / "lights.csv").write_text(f"id,x_cm,y_cm,z_cm\n{second},0,90,0\n{first},0,0,-80\n")
    where = PlacementOptions(unit="mm", up="-y")
    files = GeometryFiles(colmap_model(folder), folder / "lights.csv", placement=where)
    capture = import_folder(folder, tmp_path / "out", geometry=read_geometry(files))
    by_name = {light.name: light.position for light in capture.rig.lights}
    seventh, zeroth = (by_name[name] for name in sorted(by_name, reverse=True))
    # down and ahead, 0, 0.9 and -0.8 m, become -z and y
    np.testing.assert_allclose(seventh - zeroth, [0, 0.8, -0.9], atol=1e-9)
    found = {
        light: capture.olat("left")[0][i, 0, 0, 0] for i, light in enumerate(capture.olat_lights())
    }
    assert [found[name] for name in sorted(found)] == [10, 11]


def test_cameras_and_lights_of_others(folder: Path, tmp_path: Path) -> None:
    """A COLMAP model in millimetres for pictures of twice the size, lights as directions."""
    sparse = colmap_model(folder)
    directions = {"light_00": [0, -1, 0], "light_07": [0, 0, 1]}
    (folder / "lights.json").write_text(json.dumps(directions))
    where = PlacementOptions(unit="mm", up="-y")
    files = GeometryFiles(
        cameras=sparse, lights=folder / "lights.json", light_distance=1.5, placement=where
    )
    geometry = read_geometry(files)
    assert f"{sparse} has no unit: mm is assumed (--unit)" in geometry.notes
    capture = import_folder(folder, tmp_path / "out", geometry=geometry)
    first, left = capture.rig.cameras
    assert [first.name, left.name] == list(CAMERAS)
    np.testing.assert_allclose(first.K, [[50, 0, 3.5], [0, 50, 2.5], [0, 0, 1]])
    np.testing.assert_allclose(first.center, [0, -1, 0], atol=1e-12)  # z, ahead, becomes y
    np.testing.assert_allclose(left.center, [1, -0.01, 0], atol=1e-12)
    np.testing.assert_allclose(left.R[1], [0, 0, -1], atol=1e-12)
    above, ahead = capture.rig.lights
    point = above.position - [0, 0, 1.5]
    np.testing.assert_allclose(ahead.position - point, [0, 1.5, 0], atol=1e-9)
    assert np.linalg.norm(point) < 0.02
    assert above.intensity.tolist() == [1, 1, 1]
    assert capture.olat("left")[0][:, 0, 0, 0].tolist() == [10, 11]


@pytest.mark.parametrize(
    ("beside", "says"),
    [("left", ""), ("rihgt", "no camera 'rihgt'; there are cam_00, left"), (1, "name, got 1")],
)
def test_the_camera_that_a_light_of_others_is_beside(folder: Path, beside, says: str) -> None:
    cameras, lights = folder / "stage.json", folder / "lamps.json"
    lens = {"K": [[50, 0, 3.5], [0, 50, 2.5], [0, 0, 1]], "width": 8, "height": 6, "T": [0, 0, 1]}
    turned = {**lens, "R": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]}
    cameras.write_text(json.dumps({"cam_00": {**lens, "R": np.eye(3).tolist()}, "left": turned}))
    lights.write_text(json.dumps([{"position": [0, -1, 0], "colocated_camera": beside}]))
    files = GeometryFiles(cameras=cameras, lights=lights, placement=PlacementOptions(up="-y"))
    if not says:
        assert [light.beside for light in read_geometry(files).lights] == ["left"]
        return
    with pytest.raises(ValueError, match=rf"lamps\.json: .*light_000.*colocated_camera.*{says}"):
        read_geometry(files)


def test_never_writes_over_something(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="new or empty"):
        import_folder(folder, tmp_path)
    with pytest.raises(ImportProblem, match="nowhere: no such folder"):
        import_folder(tmp_path / "nowhere", tmp_path / "out")


def test_a_capture_rendered_by_cycles(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    source = shared_data("captures/cycles_wavy")
    capture = import_folder(source, tmp_path / "out")
    assert isinstance(capture, Capture)
    assert len(capture.rig.cameras) == 8
    assert len(capture.olat_lights()) == 10
    besides = [light.beside for light in capture.rig.lights]
    assert besides == [*(c.name for c in capture.rig.cameras), None, None]
    for light, camera in zip(capture.rig.lights, capture.rig.cameras, strict=False):
        assert np.allclose(light.position, camera.center, atol=1e-6)
    original, _ = read_exr(source / "images" / "cam_03" / "light_05.exr")
    step = capture.of_kind("olat")[5]
    np.testing.assert_array_equal(capture.response(step, "cam_03"), original)
    for camera in capture.rig.cameras:
        mask = capture.mask(camera.name)
        assert mask is not None
        assert 0.1 < mask.mean() < 0.6
    assert verify(tmp_path / "out") == []


def test_lights_without_cameras_are_not_left_unread(folder: Path) -> None:
    with pytest.raises(PlacementError, match="--lights requires --cameras"):
        read_geometry(GeometryFiles(lights=folder / "lights.json"))
