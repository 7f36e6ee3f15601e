"""From captures of known fibres to strands, and captures that have too little of something."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from benchmarks.light_codes.patches import part_of
from benchmarks.strand_truth import Ball

from reconstruction.capture.folder import Capture, CaptureError
from reconstruction.evaluation.matching import compare_strands
from reconstruction.files.strands import read_strands
from reconstruction.geometry.strands import Strands
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.images.orientation import LogGaborBank
from reconstruction.light_codes.light_code_options import LightCodeOptions
from reconstruction.light_codes.search import SearchOptions
from reconstruction.model import Model
from reconstruction.pipeline import ReconstructOptions, reconstruct

QUICK = ReconstructOptions(
    light_codes=LightCodeOptions(
        bank=LogGaborBank(count=16, spread=1.0, wavelength=5.0),
        search=SearchOptions(candidates=8, samples=9, step=5e-4),
        deepest=0.03,
    )
)


@pytest.fixture(scope="module")
def shot(fibres: Any, tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return fibres.shoot(tmp_path_factory.mktemp("fibres") / "capture")  # type: ignore[no-any-return]


def run(capture: Capture, model: Path, method: str = "photometric") -> Any:
    return reconstruct(capture, Model(model), method=method, options=QUICK)  # type: ignore[arg-type]


def test_photometric_finds_the_fibres_and_reports_what_it_saw(
    shot: Capture, fibres: Any, tmp_path: Path
) -> None:
    report = run(shot, tmp_path)
    strands = read_strands(tmp_path / "strands.npz")
    figures = compare_strands(strands, fibres.strands, samples=None)["all"]
    assert figures["2mm_20deg"]["f"] > 0.6
    codes = report["lightcodes"].figures
    assert codes["lights"] == 36
    assert codes["cameras_with_a_light_beside"] == len(fibres.cameras)
    assert report["depth"].figures["visible_neighbours"] > 2
    assert "roots" in [x.what for x in report["strands"].left_out]
    # upper ends first: nobody gave a head
    assert (strands.roots[:, 2] >= strands.points[strands.offsets[1:] - 1][:, 2]).all()


def test_the_baseline_runs_on_the_same_capture(shot: Capture, fibres: Any, tmp_path: Path) -> None:
    run(shot, tmp_path, "lmvs")
    figures = compare_strands(read_strands(tmp_path / "strands.npz"), fibres.strands, samples=None)
    assert figures["all"]["3mm_30deg"]["f"] > 0.5


def test_no_light_beside_a_camera_is_said(
    make_fibres: Any, fibre_lamps: Any, tmp_path: Path
) -> None:
    stage = make_fibres()
    lights = [replace(x, position=x.position * [1, 1, -1]) for x in fibre_lamps(20)]
    report = run(make_fibres(lights=lights).shoot(tmp_path / "capture"), tmp_path / "model")
    assert report["lightcodes"].figures["cameras_with_a_light_beside"] < len(stage.cameras)
    assert any("no light stands beside" in w for w in report["lightcodes"].warnings)


def test_one_light_is_enough_for_lines(shot: Capture, tmp_path: Path) -> None:
    report = run(part_of(shot, lights=1), tmp_path)
    assert report["lightcodes"].figures["lights"] == 1


def test_fibres_are_found_in_views_that_are_all_saturated(fibres: Any, tmp_path: Path) -> None:
    run(fibres.shoot(tmp_path / "capture", brightness=50.0, full_scale=1.0), tmp_path / "model")
    strands = read_strands(tmp_path / "model" / "strands.npz")
    assert compare_strands(strands, fibres.strands, samples=None)["all"]["2mm_20deg"]["f"] > 0.8
