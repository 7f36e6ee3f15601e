"""From captures of known fibres to strands, and captures that have too little of something."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from benchmarks.light_codes.patches import part_of
from benchmarks.strand_truth import Ball

from reconstruction import (
    Capture,
    CaptureError,
    Model,
    ReconstructOptions,
    Strands,
    read_strands,
    reconstruct,
)
from reconstruction.estimate import estimate
from reconstruction.evaluation.matching import compare_strands
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.reconstruct_options import LightCodeOptions, LogGaborBank, SearchOptions

QUICK = ReconstructOptions(
    light_codes=LightCodeOptions(
        bank=LogGaborBank(count=16, spread=1.0, wavelength=5.0),
        search=SearchOptions(candidates=8, step=5e-4),
    )
)


@pytest.fixture(scope="module")
def shot(
    make_fibres: Any, fibre_lamps: Any, fibres: Any, tmp_path_factory: pytest.TempPathFactory
) -> Capture:
    stage = make_fibres(lights=fibre_lamps(16, fibres.cameras))
    return stage.shoot(tmp_path_factory.mktemp("fibres") / "capture")  # type: ignore[no-any-return]


def run(capture: Capture, model: Path, method: str = "photometric") -> Any:
    return reconstruct(capture, Model(model), method=method, options=QUICK)  # type: ignore[arg-type]


def test_photometric_finds_the_fibres_and_reports_what_it_saw(
    shot: Capture, fibres: Any, tmp_path: Path
) -> None:
    report = run(shot, tmp_path)
    reported = [s.name for s in estimate(shot, method="photometric", options=QUICK).stages]
    assert reported == [s.name for s in report.stages]
    strands = read_strands(tmp_path / "strands.npz")
    figures = compare_strands(strands, fibres.strands, samples=None)["all"]
    assert figures["2mm_20deg"]["f"] > 0.7
    codes = report["lightcodes"].figures
    assert codes["lights"] == 16
    assert codes["cameras_with_a_light_beside"] == len(fibres.cameras)
    assert report["depth"].figures["visible_neighbours"] > 2
    assert "roots" in [x.what for x in report["strands"].left_out]
    # upper ends first: nobody gave a head
    assert (strands.roots[:, 2] >= strands.points[strands.offsets[1:] - 1][:, 2]).all()


@pytest.mark.slow
def test_the_baseline_runs_on_the_same_capture(shot: Capture, fibres: Any, tmp_path: Path) -> None:
    run(part_of(shot, cameras=len(fibres.cameras), lights=12), tmp_path, "lmvs")
    figures = compare_strands(read_strands(tmp_path / "strands.npz"), fibres.strands, samples=None)
    assert figures["all"]["3mm_30deg"]["f"] > 0.5


@pytest.mark.slow
def test_no_light_beside_a_camera_gives_a_warning(
    make_fibres: Any, fibre_lamps: Any, fibre_cameras: Any, tmp_path: Path
) -> None:
    lights = [replace(x, position=x.position * [1, 1, -1]) for x in fibre_lamps(36)]
    stage = make_fibres(cameras=fibre_cameras(4), lights=lights)
    report = run(stage.shoot(tmp_path / "capture"), tmp_path / "model")
    assert report["lightcodes"].figures["cameras_with_a_light_beside"] < len(stage.cameras)
    assert any("no light is beside" in w for w in report["lightcodes"].warnings)


@pytest.mark.slow
def test_one_light_is_enough_for_lines(shot: Capture, tmp_path: Path) -> None:
    report = run(part_of(shot, cameras=4, lights=1), tmp_path)
    assert report["lightcodes"].figures["lights"] == 1


@pytest.mark.slow
def test_fibres_are_found_in_views_that_are_all_saturated(fibres: Any, tmp_path: Path) -> None:
    bright = fibres.shoot(tmp_path / "capture", brightness=50.0, full_scale=1.0)
    run(part_of(bright, cameras=len(fibres.cameras), lights=12), tmp_path / "model")
    strands = read_strands(tmp_path / "model" / "strands.npz")
    assert compare_strands(strands, fibres.strands, samples=None)["all"]["2mm_20deg"]["f"] > 0.8


def test_missing_inputs_raise_errors_that_name_them(
    make_fibres: Any, fibre_cameras: Any, fibre_lamps: Any, tmp_path: Path
) -> None:
    fibres = make_fibres(cameras=fibre_cameras(3), lights=fibre_lamps(4))
    dark = fibres.shoot(tmp_path / "dark", brightness=0.0)
    with pytest.raises(CaptureError, match=r"no hair pixel has a direction|no segment of"):
        run(dark, tmp_path / "m")
    for name in (c.name for c in fibres.cameras):
        mask = tmp_path / "dark" / "masks" / f"{name}.png"
        cv2.imwrite(str(mask), 0 * cv2.imread(str(mask)))
    with pytest.raises(CaptureError, match="no pixel of any camera is hair"):
        run(Capture(dark.path), tmp_path / "m")
    unlit = Capture(dark.path)
    unlit.steps = tuple(s for s in unlit.steps if s.kind != "olat")
    with pytest.raises(CaptureError, match="no pixel of any camera is hair"):
        run(unlit, tmp_path / "m")


def test_cameras_that_look_away_leave_no_volume(
    make_fibres: Any, fibre_cameras: Any, fibre_lamps: Any, tmp_path: Path
) -> None:
    turned = [c.moved(np.eye(3), c.R[0] * 0.5) for c in fibre_cameras(4)]
    capture = make_fibres(cameras=turned, lights=fibre_lamps(8)).shoot(tmp_path / "capture")
    for camera in turned:  # masks of what is not there: the cameras' rays do not meet
        mask = np.full((camera.height, camera.width), 255, np.uint8)
        cv2.imwrite(str(tmp_path / "capture" / "masks" / f"{camera.name}.png"), mask)
    with pytest.raises(CaptureError):
        run(Capture(capture.path), tmp_path / "m")


def test_strands_are_cut_at_the_balls_surface() -> None:
    line = np.stack([np.linspace(-0.05, 0.05, 11), np.zeros(11), np.zeros(11)], axis=1)
    outside = line + np.array([0, 0.5, 0])
    bent = np.array([[-0.05, 0, 0], [0, 0, 0], [0, 0.05, 0], [0.005, 0.05, 0], [0.005, 0, 0]])
    found = Ball((0, 0, 0), 0.02).cut(Strands.from_list([line, outside, bent]))
    assert len(found) == 3
    assert np.linalg.norm(found.points, axis=1).max() < 0.02
    np.testing.assert_allclose(found.lengths()[0], 0.04, atol=1.1e-3)
    assert len(Ball((0, 0, 0), 0.02).cut(Strands.from_list([outside]))) == 0


def test_a_hull_is_cut_to_a_ball_and_its_grid_with_it() -> None:
    hull = VoxelGrid(np.array([-0.05, -0.05, -0.05]), 2e-3, np.ones((60, 50, 50), bool))
    center, radius = np.array([0.0, 0.01, -0.01]), 0.02013  # no centre lies on its surface
    part = Ball(tuple(center), radius).within(hull, 0.0)
    assert max(part.inside.shape) <= 22
    distance = np.linalg.norm(part.centers() - center, axis=1)
    assert distance.max() <= radius
    assert len(distance) == (np.linalg.norm(hull.centers() - center, axis=1) <= radius).sum()
    assert not Ball((1.0, 0.0, 0.0), 0.02).within(hull, 0.0).inside.any()


def test_a_camera_without_frames_of_single_lights_is_left_out_of_line_stereo(
    shot: Capture, fibres: Any, tmp_path: Path
) -> None:
    path = shutil.copytree(shot.path, tmp_path / "capture")
    name, journal = fibres.cameras[0].name, path / "journal.jsonl"
    records = [json.loads(line) for line in journal.read_text().splitlines()]
    lost = {"file": None, "reason": "dropped"}
    records = [r | lost if r.get("camera") == name else r for r in records]
    journal.write_text("".join(json.dumps(r) + "\n" for r in records))
    report = run(Capture(path), tmp_path / "model")
    assert any(w.startswith(f"{name}: no lit frame") for w in report["lightcodes"].warnings)
    strands = read_strands(tmp_path / "model" / "strands.npz")
    assert compare_strands(strands, fibres.strands, samples=None)["all"]["2mm_20deg"]["f"] > 0.6
