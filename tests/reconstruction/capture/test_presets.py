"""Folders laid out as public OLAT sets are, made here; no real set was at hand."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import camera_writers as writers
import cv2
import numpy as np
import pytest

from reconstruction import Camera, Capture, write_exr
from reconstruction.capture.import_folder import Import
from reconstruction.capture.lit_pattern import PresetProblem, find_pattern, fully_lit
from reconstruction.capture.presets import HATCH, PresetFiles, Take, read_preset, understood
from reconstruction.files.pictures import Sensor, read_picture
from reconstruction.geometry.lights import dome_positions
from stage_service.cli import main

COUNT = 331
AT_0 = [0, 20, 41, 62, 83, 104, 125, 146, 167, 188, 209, 230, 251, 272, 293, 314, 335, 348]
"""As FaceOLAT's issue 7 lists them."""
TO_Y_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]])
SUBJECT = np.array([0.6, 1.2, 0.5])  # its place in a world with y up, on the stage's floor
RNG = np.random.default_rng(5)
ORDER = RNG.permutation(COUNT)  # the light of each single frame
POSITIONS = dome_positions(COUNT, 1.6)[RNG.permutation(COUNT)]


def mean(path: Path) -> float:
    return float(cv2.imread(str(path)).mean())


def stage(names: list[str], unit: float) -> list[Camera]:
    """Cameras about the subject, in a world with y up that counts in `unit` metres."""
    out = []
    for i, name in enumerate(names):
        a = 1.3 * i
        here = Camera.look_at(
            name, 216, 410, [np.cos(a), np.sin(a), 0.3 * np.sin(2 * a)], np.zeros(3), 20
        )
        R = here.R @ TO_Y_UP.T
        center = (SUBJECT + TO_Y_UP @ here.center) / unit
        out.append(Camera(name, 216, 410, here.K, R, -R @ center))
    return out


def brightness(frames: int, first: int) -> list[int]:
    """Grey levels of a take's files: single lights 4 to 40, all of them 200; before it darkness."""
    singles = iter(RNG.integers(4, 40, frames))
    return [200 if i - first in AT_0 else int(next(singles)) for i in range(frames)]


def write_pictures(folder: Path, name: str, levels: list[int]) -> None:
    folder.mkdir(parents=True)
    for i, level in enumerate(levels):
        cv2.imwrite(str(folder / f"{name}.{i:06d}.png"), np.full((4, 2, 3), level, np.uint8))


def faceolat(root: Path, first: int, frames: int = 350) -> PresetFiles:
    """Two cameras of one take, and one that Metashape has not aligned."""
    levels = brightness(frames, first)
    for camera in ("Cam01", "Cam02", "Cam04"):
        write_pictures(root / "out" / camera / "ID20001", "ID20001", levels)
    writers.write_metashape(root / "001.xml", stage(["Cam01", "Cam02", "Cam03"], 1.0))
    lights = root / "light_pattern_metadata.json"
    places = 1000 * (SUBJECT + POSITIONS @ TO_Y_UP.T)
    lights.write_text(json.dumps({"light_positions": places.tolist()}))
    singles = iter(ORDER)
    rows = [[i, 0 if i in AT_0 else int(next(singles)) + 1] for i in range(349)]
    (root / "light_pattern_per_frame.json").write_text(json.dumps(rows))
    return PresetFiles(root / "out", cameras=root / "001.xml", lights=lights)


def lights_by_number(take: Take, camera: str) -> dict[int, str]:
    return {f.number: str(f.light) for f in take.frames if f.camera == camera and f.light}


def test_the_whole_stage_is_lit_where_the_authors_say() -> None:
    assert fully_lit(COUNT) == AT_0


@pytest.mark.parametrize("first", [0, 1])
def test_faceolat(first: int, tmp_path: Path) -> None:
    """350 files of which 331 are single lights, wherever the fully lit ones stand."""
    take = read_preset("faceolat", faceolat(tmp_path, first), mean)
    assert sorted(map(str, take.geometry.cameras)) == ["Cam01", "Cam02"]
    assert any("Cam04: no pose" in n for n in take.geometry.notes)
    assert any(f"frames {first}, {20 + first}, " in n for n in take.geometry.notes)
    assert Counter(f.kind for f in take.frames) == {"olat": 2 * COUNT, "tracking": 2 * len(AT_0)}
    singles = [i for i in range(349) if i not in AT_0]
    expected = {i + first: f"light_{ORDER[k]:03d}" for k, i in enumerate(singles)}
    assert lights_by_number(take, "Cam02") == expected
    tracking = {f.number for f in take.frames if f.kind == "tracking"}
    assert tracking == {i + first for i in AT_0}
    path = next(f.path for f in take.frames if f.number == 42 and f.camera == "Cam01")
    assert path.name == "ID20001.000042.png"
    assert any("Cam03: no images" in n for n in take.geometry.notes)
    observed = Import.of(tmp_path / "out", take.geometry, *understood(take))
    assert observed.missing == []
    assert [s.light for s in observed.found.steps[1:3]] == [f"light_{k:03d}" for k in ORDER[:2]]
    assert [(c.width, c.height) for c in observed.rig.cameras] == [(2, 4), (2, 4)]
    # the world: metres, z up, lights and cameras about the same place
    place = np.linalg.inv(TO_Y_UP) @ SUBJECT
    found = np.array([light.position for light in take.geometry.lights])
    np.testing.assert_allclose(found, place + POSITIONS, atol=1e-9)
    camera = take.geometry.cameras["Cam01"]
    np.testing.assert_allclose(camera.center, np.add(place, [1, 0, 0]), atol=1e-6)


def test_frames_that_are_lit_where_they_should_not_be_are_left_out(tmp_path: Path) -> None:
    """As issue 8 has it: the first frames of some takes are fully lit. One file is missing."""
    files = faceolat(tmp_path, 1)
    (files.folder / "Cam02" / "ID20001" / "ID20001.000100.png").unlink()
    for camera in ("Cam01", "Cam02"):
        for i in range(1, 16):
            path = files.folder / camera / "ID20001" / f"ID20001.{i:06d}.png"
            cv2.imwrite(str(path), np.full((4, 2, 3), 190, np.uint8))
    take = read_preset("faceolat", files, mean)
    assert len(lights_by_number(take, "Cam01")) == COUNT - 14
    lost = lights_by_number(take, "Cam01").items() - lights_by_number(take, "Cam02").items()
    assert [number for number, _ in lost] == [100]
    assert any("frames 2, 3, 4," in n and "skipped" in n for n in take.geometry.notes)


def test_takes_without_the_pattern_are_refused(tmp_path: Path) -> None:
    order = [-1 if i in AT_0 else 0 for i in range(349)]
    level = RNG.uniform(4, 40, 350)
    with pytest.raises(PresetProblem, match="fully lit frames are not brighter"):
        find_pattern(level, order)
    level[[*AT_0, *range(190, 250)]] = 300
    with pytest.raises(PresetProblem, match=r"the frames 0, 20, 41.* cannot be identified"):
        find_pattern(level, order)
    with pytest.raises(PresetProblem, match="300 frames, expected 349"):
        find_pattern(level[:300], order)
    files = faceolat(tmp_path, 0)
    with pytest.raises(PresetProblem, match="give --lights relighting"):
        read_preset("faceolat", PresetFiles(files.folder), mean)
    with pytest.raises(PresetProblem, match="expected CamNN/ID20001"):
        read_preset("faceolat", PresetFiles(tmp_path, lights=files.lights), mean)
    (files.folder / "Cam01" / "ID30001").mkdir()
    with pytest.raises(PresetProblem, match="give --take, one of ID20001, ID30001"):
        read_preset("faceolat", files, mean)


def test_humanolat(tmp_path: Path) -> None:
    """Cameras in millimetres, lights in metres; 14 other frames before the pattern."""
    pose, shared = tmp_path / "SUBJECT_C003" / "POSE_00", tmp_path / "SUBJECT_C003" / "shared"
    levels = [230, *RNG.integers(60, 150, 13), *brightness(350, 0)]
    for camera in ("Cam01", "Cam02"):
        write_pictures(pose / "images_processed" / camera, "C003", levels)
        masks = pose / "segmentations" / "masks" / "000"
        masks.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(masks / f"{camera}.png"), np.full((4, 2), 255, np.uint8))
    shared.mkdir()
    writers.write_calib(shared / "cameras.calib", stage(["Cam01", "Cam02", "Cam03"], 1.0))
    places = SUBJECT + POSITIONS @ TO_Y_UP.T
    vertices = "\n".join(f"v {x!r} {y!r} {z!r}" for x, y, z in places.tolist())
    (shared / "LSX_light_positions_aligned.pc").write_text(f"# lights\n{vertices}\n")
    (shared / "LSX3_light_z_spiral.txt").write_text("\n".join(str(i + 1) for i in ORDER))
    take = read_preset("humanolat", PresetFiles(pose), mean)
    kinds = Counter(f.kind for f in take.frames if f.camera == "Cam02")
    assert kinds == {"all_on": 1, "tracking": len(AT_0), "olat": COUNT - len(HATCH)}
    singles = [i + 14 for i in range(349) if i not in AT_0]
    expected = {n: f"light_{ORDER[k]:03d}" for k, n in enumerate(singles) if ORDER[k] not in HATCH}
    assert lights_by_number(take, "Cam02") == expected
    assert sorted(take.subjects) == ["Cam01", "Cam02"]
    assert not any(f"light_{i:03d}" in {x.name for x in take.geometry.lights} for i in HATCH)
    place = np.linalg.inv(TO_Y_UP) @ SUBJECT
    np.testing.assert_allclose(
        take.geometry.cameras["Cam01"].center, np.add(place, [1, 0, 0]), atol=1e-6
    )
    assert take.sensor == Sensor(response="srgb")
    (pose / "images_processed").rename(pose / "images_raw")
    assert read_preset("humanolat", PresetFiles(pose), mean).sensor == Sensor(response="srgb")


@pytest.mark.slow
def test_the_command_imports_a_take_of_avif(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """By `hairstage import`; AVIF has a power of 2.2 without sRGB's toe."""
    files = faceolat(tmp_path, 0)
    for path in (files.folder / "Cam02").rglob("*.png"):
        path.unlink()
    picture = np.zeros((16, 8, 3), np.uint8)
    for path in (files.folder / "Cam01").rglob("*.png"):
        picture[4:12, 2:6] = cv2.imread(str(path))[0, 0]
        cv2.imwrite(str(path.with_suffix(".avif")), picture, [cv2.IMWRITE_AVIF_QUALITY, 100])
        path.unlink()
    arguments = [
        "--preset",
        "faceolat",
        "--cameras",
        str(files.cameras),
        "--lights",
        str(files.lights),
    ]
    out = tmp_path / "capture"
    assert main(["import", str(files.folder), *arguments, "--out", str(out), "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert output["frames"] == 349
    assert any("fully lit in the frames 0, 20, …" in n for n in output["notes"])
    capture = Capture(out)
    assert len(capture.of_kind("tracking")) == len(AT_0)
    share = capture.frame(capture.of_kind("tracking")[0], "Cam01")[8, 4]
    np.testing.assert_allclose(share, (200 / 255) ** 2.2, rtol=0.02)


def test_faceolat_exposure_and_colours(tmp_path: Path) -> None:
    """Takes ID20088 to ID20116 are twice as bright as their files; EXR has no colour matrix yet."""
    files = faceolat(tmp_path, 0)
    take = read_preset("faceolat", files, mean)
    assert take.sensor == Sensor(response=2.2)
    for name, seconds in (("ID20087", 1.0), ("ID20116", 0.5), ("ID30090", 1.0)):
        for folder in files.folder.glob("Cam*/ID*"):
            folder.rename(folder.with_name(name))
        take = read_preset("faceolat", files, mean)
        _, found = understood(take)
        assert {tuple(b) for b in found.frames.values()} == {(seconds,)}
        assert any("half the exposure" in n for n in take.geometry.notes) == (seconds == 0.5)
    for path in files.folder.rglob("*.png"):
        path.rename(path.with_suffix(".exr"))
    repository = tmp_path / "FaceOLAT"
    lights = repository / "relighting" / "lights" / files.lights.name
    lights.parent.mkdir(parents=True)
    for path in tmp_path.glob("light_pattern*.json"):
        path.rename(lights.parent / path.name)
    levels = dict(enumerate(brightness(350, 0)))

    def of_name(path: Path) -> float:
        return float(levels[int(path.stem[-6:])])

    files = replace(files, lights=lights)
    assert read_preset("faceolat", files, of_name).sensor == Sensor(response="linear")
    colours = repository / "color-calibration" / "colorcalib_exr.mat"
    colours.parent.mkdir()
    colours.write_text("1.5 0 0.25 0\n0 1 0 0\n0 0 2 0\n0 0 0 1\n")
    sensor = read_preset("faceolat", files, of_name).sensor
    write_exr(tmp_path / "red.exr", np.full((2, 2, 3), [0.4, 0.2, 0.1], np.float32))
    light = read_picture(tmp_path / "red.exr", sensor, (2, 2)).light
    np.testing.assert_allclose(light[0, 0], [0.625, 0.2, 0.2], rtol=1e-3)
