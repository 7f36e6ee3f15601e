"""Folders in the layouts of public sets import with the right cameras, lights and pixels.

Each picture has its frame's number and its camera in black and white cells, whatever the curve.
The layouts are those of the authors' own tools: FaceOLAT's README and relighting/, HumanOLAT's
olat_explorer.py and train_tools.py, OpenIllumination's open_illumination.py and loader, EasyMocap's
camera_utils.py, nersemble_data's constants.py; GaussianHaircut's is in test_photographs.py.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import camera_writers as writers
import cv2
import numpy as np
import pytest
import users_cameras as readers

from reconstruction import Camera, Capture, write_exr
from reconstruction.geometry.lights import dome_positions
from stage_service.cli import main

WIDTH, HEIGHT, CELL, BITS = 32, 24, 4, 12
COUNT = 64
RNG = np.random.default_rng(5)
SUBJECT = np.array([0.6, 1.2, 0.5])
"""In a world with y up, metres."""
LIGHTS = SUBJECT + dome_positions(COUNT, 1.6)[RNG.permutation(COUNT)] @ [
    [1, 0, 0], [0, 0, -1], [0, 1, 0]
]  # fmt: skip
LIT = (0, 20, 41, 62, 68)
"""Frames of the pattern in which the whole stage is lit (HumanOLAT's olat_explorer.py: 14, 34, 55,
76, …, and after the last light)."""
RADIANCE = 0.37


def stage(names: list[str]) -> list[Camera]:
    out = []
    for i, name in enumerate(names):
        a = 1.3 * i
        eye = np.array([np.cos(a), 0.3 * np.sin(2 * a), np.sin(a)])
        turned = Camera.look_at(name, WIDTH, HEIGHT, eye[[0, 2, 1]] * [1, -1, 1], np.zeros(3), 20)
        R = turned.R @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
        out.append(Camera(name, WIDTH, HEIGHT, turned.K, R, -R @ (SUBJECT + eye)))
    return out


def cells(number: int, camera: int, lit: bool = False) -> np.ndarray:
    """`(H, W)`: bits and their complements; the rest is black, or white if the stage is lit."""
    bits = [(8 * number + camera) >> k & 1 for k in range(BITS)]
    code = np.array(bits + [1 - b for b in bits], bool).reshape(4, -1)
    out = np.full((HEIGHT, WIDTH), lit)
    code = code.repeat(CELL, axis=0).repeat(CELL, axis=1)
    out[: code.shape[0], : code.shape[1]] = code
    return out


def number_of(image: np.ndarray) -> tuple[int, int]:
    """The number and the camera in the cells of a frame."""
    code = image[: 4 * CELL, : BITS // 2 * CELL].mean(axis=2)
    means = code.reshape(4, CELL, -1, CELL).mean(axis=(1, 3)).ravel()
    bits = means > means.max() / 2
    assert (bits[:BITS] != bits[BITS:]).all()
    return divmod(int((bits[:BITS] << np.arange(BITS)).sum()), 8)


def put(path: Path, shown: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".exr":
        write_exr(path, np.repeat(RADIANCE * shown[..., None], 3, axis=2).astype(np.float32))
    else:
        best = {".avif": [cv2.IMWRITE_AVIF_QUALITY, 100], ".png": []}
        levels = np.repeat(200 * shown[..., None], 3, axis=2).astype(np.uint8)
        options = best.get(path.suffix, [cv2.IMWRITE_JPEG_QUALITY, 100])
        assert cv2.imwrite(str(path), levels, options)


@dataclass
class Set:
    """What a folder has: `words` of the import; cameras by their own parser; `numbers`, the frame
    of each light, in the order of the file; `unit` of the cameras in metres."""

    folder: Path
    words: list[str]
    pixels: readers.Pixels
    numbers: Mapping[int, int]
    cameras: list[str]
    unit: float = 1.0


def takes(folder: Path, name: str, cameras: list[str], order: np.ndarray, skip: int) -> dict:
    """Pictures of a take; returns the frame of each light. `name` has the camera and the number."""
    singles, numbers = iter(order), {}
    for i in range(skip + COUNT + len(LIT)):
        lit = i - skip in LIT
        if i >= skip and not lit:
            numbers[int(next(singles))] = i
        for k, camera in enumerate(cameras):
            put(folder / name.format(camera=camera, i=i), cells(i, k, lit))
    return numbers


def faceolat(root: Path) -> Set:
    cameras, order = ["Cam01", "Cam02"], RNG.permutation(COUNT)
    numbers = takes(root / "OutputEXR", "{camera}/ID20001/ID20001.{i:06d}.exr", cameras, order, 1)
    writers.write_metashape(root / "001.xml", stage(cameras))
    lights = root / "light_pattern_metadata.json"
    lights.write_text(json.dumps({"light_positions": (1000 * LIGHTS).tolist()}))
    frame = {n - 1: light + 1 for light, n in numbers.items()}
    rows = [[i, frame.get(i, 0)] for i in range(COUNT + len(LIT))]
    (root / "light_pattern_per_frame.json").write_text(json.dumps(rows))
    words = ["--cameras", str(root / "001.xml"), "--lights", str(lights), "--preset", "faceolat"]
    pixels = readers.of_metashape(root / "001.xml")
    return Set(root / "OutputEXR", words, pixels, numbers, cameras)


def humanolat(root: Path) -> Set:
    """Frame 0 is white, 1 to 13 are gradients and environments; millimetres, lights in metres."""
    cameras, order = ["Cam01", "Cam02"], RNG.permutation(COUNT)
    pose, shared = root / "SUBJECT_C003" / "POSE_00", root / "SUBJECT_C003" / "shared"
    numbers = takes(pose / "images_processed", "{camera}/C003.{i:06d}.avif", cameras, order, 14)
    shared.mkdir()
    writers.write_calib(shared / "cameras.calib", stage(cameras))
    vertices = "\n".join(f"v {x!r} {y!r} {z!r}" for x, y, z in LIGHTS.tolist())
    (shared / "LSX_light_positions_aligned.pc").write_text(vertices + "\n")
    (shared / "LSX3_light_z_spiral.txt").write_text("\n".join(str(i + 1) for i in order))
    pixels = readers.of_calib(shared / "cameras.calib", WIDTH)
    return Set(pose, ["--preset", "humanolat"], pixels, numbers, cameras, 1e-3)


def write_openillumination(folder: Path, cameras: list[str], lights: list[int]) -> None:
    for k, camera in enumerate(stage(cameras)):
        table = folder / "output" / f"transforms_{('train', 'test')[k % 2]}.json"
        table.parent.mkdir(parents=True, exist_ok=True)
        data = json.loads(table.read_text()) if table.exists() else {"frames": {}}
        right, down, forward = camera.R
        matrix = np.eye(4)
        matrix[:3] = np.stack([right, -down, -forward, camera.center], axis=1)
        angle = 2 * np.arctan(WIDTH / 2 / camera.K[0, 0])
        frame = {"file_path": f"./images/{camera.name}", "camera_angle_x": angle}
        data["frames"][camera.name] = frame | {"transform_matrix": matrix.tolist()}
        table.write_text(json.dumps(data))
        put(folder / "output" / "obj_masks" / f"{camera.name}.png", cells(0, 0))
        for i in lights:
            name = f"{i:03d}/raw_undistorted/{camera.name}.JPG"
            put(folder / "Lights" / name, cells(i, k))


def openillumination(root: Path) -> Set:
    cameras, folder = ["A1", "B3", "CE2", "CF8"], root / "OLAT" / "obj_20_greenhead"
    write_openillumination(folder, cameras, list(range(COUNT)))
    np.save(root / "light_pos.npy", LIGHTS)
    tables = sorted((folder / "output").glob("*.json"))
    pixels = readers.of_openillumination(tables, WIDTH, HEIGHT)
    words = ["--preset", "openillumination", "--up", "y"]
    return Set(folder, words, pixels, dict(zip(range(COUNT), range(COUNT), strict=True)), cameras)


def easymocap(root: Path) -> Set:
    """A number of six digits for each light."""
    cameras = ["01", "02", "03"]
    writers.write_easymocap(root / "calib", stage(cameras), sizes=False)
    for name in ("intri.yml", "extri.yml"):
        (root / "calib" / name).rename(root / name)
    np.savetxt(root / "lights.csv", LIGHTS, delimiter=",", header="x,y,z", fmt="%.9f")
    for i in range(COUNT):
        for k, camera in enumerate(cameras):
            put(root / "images" / camera / f"{i:06d}.jpg", cells(i, k))
    pixels, numbers = readers.of_easymocap(root), dict(zip(range(COUNT), range(COUNT), strict=True))
    return Set(root, ["--up", "y"], pixels, numbers, cameras)


@pytest.mark.parametrize("write", [faceolat, humanolat, openillumination, easymocap])
def test_a_set_is_imported_as_its_files_say(write: Callable[[Path], Set], tmp_path: Path) -> None:
    of = write(tmp_path)
    assert main(["import", str(of.folder), "--out", str(tmp_path / "capture"), *of.words]) == 0
    capture = Capture(tmp_path / "capture")
    world = capture.world
    assert world is not None

    # cameras: the file's own points, by its own parser
    points = (SUBJECT + RNG.uniform(-0.1, 0.1, (40, 3))) / of.unit
    expected = of.pixels(points)
    assert sorted(c.name for c in capture.rig.cameras) == of.cameras == sorted(expected)
    for camera in capture.rig.cameras:
        found = camera.project(world.to_stage(points))[0]
        np.testing.assert_allclose(found, expected[camera.name], atol=1e-3)

    # lights: which place shone in which frame
    numbers = {}
    for step in capture.of_kind("olat"):
        place = of.unit * world.to_user(capture.rig.light(str(step.light)).position[None])
        away = np.linalg.norm(LIGHTS - place, axis=1)
        assert away.min() < 1e-6
        codes = [number_of(capture.frame(step, c)) for c in of.cameras]
        assert codes == [(codes[0][0], k) for k in range(len(of.cameras))]
        numbers[int(away.argmin())] = codes[0][0]
    assert numbers == of.numbers

    # pixels: white and black cells; the linear files' own radiance
    step = capture.of_kind("olat")[0]
    frame = capture.frame(step, of.cameras[0])
    if write is faceolat:
        shown = cells(*number_of(frame))
        np.testing.assert_allclose(frame[..., 1], RADIANCE * shown, atol=1e-6)
    if write is openillumination:  # sRGB, as the authors' loader
        assert frame.max() == pytest.approx(((200 / 255 + 0.055) / 1.055) ** 2.4, rel=0.03)
        subject = capture.subject("CE2")
        assert subject is not None
        np.testing.assert_array_equal(subject, cells(0, 0))


def nersemble(root: Path) -> list[str]:
    """A participant's folder: `calibration/camera_params.json`, videos under constant light."""
    images = root / "018" / "sequences" / "EXP-1-head" / "images"
    images.mkdir(parents=True)
    calibration = root / "018" / "calibration"
    calibration.mkdir()
    cameras = {c.name: np.vstack([np.c_[c.R, c.t], [0, 0, 0, 1]]) for c in stage(["222200037"])}
    params = {"world_2_cam": {k: v.tolist() for k, v in cameras.items()}}
    params |= {"intrinsics": np.eye(3).tolist()}
    (calibration / "camera_params.json").write_text(json.dumps(params))
    (images / "cam_222200037.mp4").write_bytes(bytes(64))
    return [str(root / "018")]


def lighting_patterns(root: Path) -> list[str]:
    """OpenIllumination's other half: 13 patterns of many lamps, beside the lights' positions."""
    folder = root / "lighting_patterns" / "obj_20_greenhead"
    write_openillumination(folder, ["A1", "B3"], list(range(1, 14)))
    np.save(root / "light_pos.npy", LIGHTS)
    return [str(folder), "--preset", "openillumination", "--up", "y"]


@pytest.mark.parametrize(
    ("write", "said"),
    [
        (nersemble, "cam_222200037.mp4: videos are not read: extract its frames"),
        (
            lighting_patterns,
            "by a pattern of many lamps: give a table of their weights (--patterns",
        ),
    ],
)
def test_a_set_without_single_lights_is_refused_with_the_way_on(
    write: Callable[[Path], list[str]],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = write(tmp_path)
    assert main(["import", *words, "--out", str(tmp_path / "capture")]) == 3
    assert said in capsys.readouterr().err
    assert not (tmp_path / "capture").exists()


def test_patterns_of_openillumination_are_read_with_a_table(tmp_path: Path) -> None:
    words = lighting_patterns(tmp_path)
    rows = {f"{i:03d}": [str(i), str(i + 1)] for i in range(1, 14)}
    (tmp_path / "table.json").write_text(json.dumps(rows))
    words += ["--patterns", str(tmp_path / "table.json"), "--out", str(tmp_path / "capture")]
    assert main(["import", *words]) == 0
    capture = Capture(tmp_path / "capture")
    assert capture.lightings() == list(rows)
    assert len(capture.rig.lights) == 14
    step = next(s for s in capture.steps if s.pattern == "007")
    assert number_of(capture.frame(step, "B3")) == (7, 1)


def test_what_openillumination_lacks_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Part of a download: two lights, a camera that is in no table."""
    folder = tmp_path / "OLAT" / "obj_20_greenhead"
    write_openillumination(folder, ["A1", "B3", "CE2"], [0, 40])
    np.save(tmp_path / "light_pos.npy", LIGHTS)
    put(folder / "Lights" / "040" / "raw_undistorted" / "D5.JPG", cells(40, 3))
    words = ["import", str(folder), "--preset", "openillumination", "--up", "y"]
    assert main([*words, "--out", str(tmp_path / "capture")]) == 0
    said = capsys.readouterr().err
    assert "D5: no pose, skipped" in said
    assert "62 lights have no image and are skipped: light_001" in said
    assert len(Capture(tmp_path / "capture").rig.lights) == 2
    for table in (folder / "output").glob("*.json"):
        table.write_text(json.dumps({"frames": {}}))
    assert main([*words, "--out", str(tmp_path / "other")]) == 3
    assert "none of the cameras A1, B3, CE2, D5 has a pose" in capsys.readouterr().err


def test_a_folder_that_is_not_there_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["import", str(tmp_path / "nowhere"), "--out", str(tmp_path / "capture")]) == 3
    assert f"{tmp_path / 'nowhere'}: no such folder" in capsys.readouterr().err
