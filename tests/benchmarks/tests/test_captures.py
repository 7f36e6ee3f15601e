"""The rigs of the light-plane benchmark, and the names of its captures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from benchmarks.captures import SimulatedCapture
from benchmarks.light_planes.subjects import FRAMINGS, rig_text

from stage_service.config import load_rig_file


@pytest.mark.parametrize("name", FRAMINGS)
def test_a_framing_is_a_rig_whose_cameras_see_the_hair(name: str, tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(rig_text(FRAMINGS[name]))
    rig = load_rig_file(file).rig
    assert (len(rig.cameras), len(rig.projectors), len(rig.lights)) == (8, 3, 120)
    framing = FRAMINGS[name]
    for device in (*rig.cameras, *rig.projectors):
        pixel, depth = device.project([framing.target])
        assert depth[0] > 0.9
        middle = [(device.width - 1) / 2, (device.height - 1) / 2]
        assert pixel[0] == pytest.approx(middle, abs=1)


def test_another_drift_is_another_capture_and_the_same_one_is_found_again() -> None:
    one = SimulatedCapture("a", "text", "curly")
    assert one.key() == replace(one).key()
    assert one.key() != replace(one, drift_mm=1.0).key()
    assert one.key() != replace(one, rig="other").key()


def test_a_subject_is_its_file_wherever_that_lies(tmp_path: Path) -> None:
    here, there = tmp_path / "a.npz", tmp_path / "b.npz"
    here.write_bytes(b"strands")
    there.write_bytes(b"strands")
    one = SimulatedCapture("a", "text", str(here))
    assert one.key() == replace(one, subject=str(there)).key()
    there.write_bytes(b"others")
    assert one.key() != replace(one, subject=str(there)).key()
