"""Statuses that are kept: the same as those that are read, and never older than the folder."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from reconstruction import Camera, CaptureWriter, Light, Rig, Step
from stage_service.acquisition.states import CaptureStatus, read_status
from stage_service.captures import status_index
from stage_service.captures.status_index import StatusIndex

STEPS = (Step(0, "dark", 0.01), Step(1, "olat", 0.01, light="light_000"))


def capture(folder: Path, outcome: str | None = "completed") -> Path:
    camera = Camera.look_at("cam_0", 8, 6, [0, -1, 0], [0, 0, 0], 20)
    lamp = Light("light_000", np.array([0.0, -1.0, 0.0]), np.ones(3))
    writer = CaptureWriter.create(folder, Rig("tiny", (camera,), (lamp,)), {"steps": STEPS})
    writer.write_frame(STEPS[0], "cam_0", np.zeros((6, 8, 3), np.float32))
    if outcome is None:
        writer.close()
    else:
        writer.finish(outcome)
    return folder


def read_statuses(folders: list[Path], file: Path) -> dict[str, CaptureStatus]:
    """As a start does: each is asked for, then the index is kept."""
    index = StatusIndex(file)
    found = {folder.name: index.status(folder) for folder in folders}
    index.save()
    return found


@pytest.fixture
def folders(tmp_path: Path) -> list[Path]:
    broken = tmp_path / "captures" / "broken"
    broken.mkdir(parents=True)
    (broken / "plan.json").write_text("[")
    return [
        broken,
        capture(tmp_path / "captures" / "done"),
        capture(tmp_path / "captures" / "left", None),
    ]


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the folders that were really read."""
    names = []

    def noting(folder: Path):
        names.append(folder.name)
        return read_status(folder)

    monkeypatch.setattr(status_index, "read_status", noting)
    return names


def test_unchanged_captures_are_not_read_again(folders, read, tmp_path):
    index = tmp_path / "index"
    expected = {f.name: read_status(f) for f in folders}
    assert read_statuses(folders, index) == expected
    assert read == ["broken", "done", "left"]
    assert read_statuses(folders, index) == expected
    assert read[3:] == ["broken"]  # what is damaged is looked at again
    (folders[0] / "plan.json").write_text("{}")
    CaptureWriter.reopen(folders[2]).finish("aborted")
    assert read_statuses(folders, index)["left"].outcome == "aborted"
    assert read[4:] == ["broken", "left"]


def test_a_root_that_was_moved_is_where_it_is(folders, read, tmp_path):
    read_statuses(folders, tmp_path / "index")
    moved = (tmp_path / "captures").rename(tmp_path / "elsewhere")
    found = read_statuses([moved / "done"], tmp_path / "index")
    assert found["done"].path == str(moved / "done")
    assert "done" not in read[3:]
    shutil.rmtree(moved / "done")
    assert read_statuses([], tmp_path / "index") == {}


@pytest.mark.parametrize(
    "text", ["", "[", '["done"]', '["done", 1, {}]', "\x00\xff", "[NaN, 1, 2]"]
)
def test_an_index_that_cannot_be_read_is_made_anew(folders, text, tmp_path):
    index = tmp_path / "index"
    index.write_text(text, encoding="latin-1")
    assert read_statuses(folders, index) == {f.name: read_status(f) for f in folders}
    assert len(index.read_text().splitlines()) == 2


def test_the_index_is_ignored_for_changed_files(folders, read, tmp_path):
    """Cut by a byte, with the time of before."""
    index, journal = tmp_path / "index", folders[1] / "journal.jsonl"
    read_statuses(folders, index)
    before = journal.stat()
    journal.write_bytes(journal.read_bytes()[:-40])
    os.utime(journal, ns=(before.st_atime_ns, before.st_mtime_ns))
    read_statuses(folders, index)
    assert "done" in read[3:]
