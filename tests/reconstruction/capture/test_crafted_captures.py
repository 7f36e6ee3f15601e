"""Capture folders that somebody made to reach what lies outside of them."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reconstruction import (
    Camera,
    Capture,
    CaptureError,
    CaptureWriter,
    Light,
    Rig,
    Step,
    read_obj,
    verify,
)
from reconstruction.capture.compression import compress
from reconstruction.capture.writer import sha256
from reconstruction.containment import NotContained, inside, is_file_name, plain_file
from reconstruction.geometry.rig import RigError

CAMERA = Camera.look_at("cam_0", 8, 6, [0, -1, 0], [0, 0, 0], 20)
RIG = Rig("one", (CAMERA,), (Light("light_0", np.ones(3), np.ones(3)),))
STEPS = [Step(i, "olat", 0.02, light="light_0") for i in range(2)]


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    writer = CaptureWriter.create(tmp_path / "c", RIG, {"steps": STEPS})
    for step in STEPS:
        writer.write_frame(step, "cam_0", np.full((6, 8, 3), 7, np.float32))
    writer.finish("completed", {})
    return tmp_path / "c"


@pytest.fixture
def victim(capture: Path, tmp_path: Path) -> Path:
    """A frame of another folder, of the name that compression looks for."""
    file = tmp_path / "victim" / "cam_0.exr"
    file.parent.mkdir()
    file.write_bytes((capture / "frames" / "00000" / "cam_0.exr").read_bytes())
    return file


def change(capture: Path, **fields: Any) -> None:
    """Change the journal's first line."""
    path = capture / "journal.jsonl"
    first, *others = path.read_text().splitlines()
    path.write_text("\n".join([json.dumps({**json.loads(first), **fields}), *others]) + "\n")


@pytest.mark.parametrize("absolute", [True, False])
def test_a_journal_that_names_a_file_elsewhere(capture, victim, absolute):
    change(capture, file=str(victim) if absolute else "../victim/cam_0.exr", sha256=sha256(victim))
    read = Capture(capture)
    with pytest.raises(CaptureError, match="leads out of"):
        read.frame(STEPS[0], "cam_0")
    assert read.frame(STEPS[1], "cam_0").mean() == 7
    with pytest.raises(CaptureError, match="leads out of"):
        compress(capture)
    assert list(victim.parent.iterdir()) == [victim]
    assert any("leads out of" in problem for problem in verify(capture))


def test_a_frame_that_is_a_link(capture, victim):
    frame = capture / "frames" / "00000" / "cam_0.exr"
    frame.unlink()
    frame.symlink_to(victim)
    with pytest.raises(CaptureError, match="leads out of"):
        Capture(capture).frame(STEPS[0], "cam_0")
    frame.unlink()
    frame.symlink_to(capture / "frames" / "00001" / "cam_0.exr")
    assert Capture(capture).frame(STEPS[0], "cam_0").mean() == 7


@pytest.mark.parametrize("name", ["rig.json", "plan.json", "journal.jsonl", "manifest.json"])
def test_an_own_file_that_is_a_link_or_a_pipe(capture, tmp_path, name):
    (capture / name).rename(tmp_path / name)
    (capture / name).symlink_to(tmp_path / name)
    with pytest.raises(CaptureError, match="leads out of"):
        _ = Capture(capture).manifest
    (capture / name).unlink()
    os.mkfifo(capture / name)
    with pytest.raises(CaptureError, match=r"expected rig.json and plan.json|no plain file"):
        _ = Capture(capture).manifest


def test_frames_in_a_linked_folder_are_not_continued(capture, tmp_path):
    (capture / "frames" / "00001").rename(tmp_path / "elsewhere")
    (capture / "frames" / "00001").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(NotContained, match="leads out of"):
        CaptureWriter.reopen(capture)


@pytest.mark.parametrize("name", ["../x", "/x", "a/b", "..", "", ".x", "a\0b", "a\\b", "n" * 101])
def test_devices_whose_names_are_no_file_names(capture, name):
    assert not is_file_name(name)
    rig = capture / "rig.json"
    rig.write_text(rig.read_text().replace('"cam_0"', json.dumps(name)))
    with pytest.raises((RigError, CaptureError), match=r"cannot be a name|has NUL"):
        Capture(capture)


@pytest.mark.parametrize("name", ["a", "a/b", "a/../b", "..a", "ü", "a/./b"])
def test_names_that_stay_inside(tmp_path, name):
    assert inside(tmp_path, name) == tmp_path / name


@pytest.mark.parametrize("name", ["", ".", "..", "a/../..", "../c", "/", "a\0", "n" * 300, None, 3])
def test_names_that_do_not(tmp_path, name):
    with pytest.raises(NotContained):
        inside(tmp_path, name)


def test_pipes_devices_and_folders_are_not_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe.obj")
    for path in (tmp_path / "pipe.obj", Path("/dev/zero"), tmp_path):
        with pytest.raises(NotContained, match="no plain file"):
            read_obj(path)
    (tmp_path / "big").write_bytes(b"12345")
    assert plain_file(tmp_path / "big", most=5) == tmp_path / "big"
    with pytest.raises(NotContained, match="5 bytes; at most 4"):
        plain_file(tmp_path / "big", most=4)
