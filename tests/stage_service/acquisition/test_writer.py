"""Frames on their way to disk: in order, bounded, and no error lost."""

from __future__ import annotations

import json
import random
import threading
import time
from typing import Any

import numpy as np
import pytest

from reconstruction import CaptureWriter, Step
from stage_service.acquisition.frame_queue import FrameWriter, Shot
from stage_service.config import RigFile
from stage_service.devices.cameras.interface import CameraInfo, Frame

STEPS = tuple(Step(i, "olat", 0.01, light=f"light_{i:03d}") for i in range(20))
INFO = CameraInfo(8, 6, 4095, 64, 10000.0)


def shot(step: Step) -> Shot:
    frame = Frame(np.full((6, 8, 3), 164 + step.index, np.uint16), step.index + 1, 0.5, 0.01)
    return Shot(step, "cam_0", frame, INFO, step.index + 1, 0)


@pytest.fixture
def folder(rig_file: RigFile, tmp_path: Any) -> CaptureWriter:
    return CaptureWriter.create(tmp_path / "c", rig_file.rig, {"steps": STEPS})


def test_frames_are_journalled_in_order_however_long_each_takes(folder, monkeypatch):
    store = folder.store_frame

    def slow(*args: Any, **more: Any) -> Any:
        time.sleep(random.Random(args[0].index).uniform(0, 0.02))
        return store(*args, **more)

    monkeypatch.setattr(folder, "store_frame", slow)
    writer = FrameWriter(folder, 4)
    for step in STEPS:
        writer.put(shot(step))
    writer.close()
    folder.close()
    lines = [json.loads(line) for line in (folder.path / "journal.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == list(range(20))
    assert [(line["pulse"], line["block_id"]) for line in lines] == [(i, i) for i in range(1, 21)]


def test_a_slow_disk_makes_put_wait_instead_of_dropping(folder, monkeypatch):
    go, stored = threading.Event(), folder.store_frame

    def blocked(*args: Any, **more: Any) -> Any:
        go.wait(10)
        return stored(*args, **more)

    monkeypatch.setattr(folder, "store_frame", blocked)
    writer = FrameWriter(folder, 2)
    done: list[int] = []

    def put_all() -> None:
        for step in STEPS:
            writer.put(shot(step))
            done.append(step.index)

    putting = threading.Thread(target=put_all)
    putting.start()
    putting.join(0.2)
    assert putting.is_alive()
    assert len(done) < len(STEPS)
    go.set()
    putting.join(10)
    writer.close()
    assert folder.counts() == (20, 0)
    folder.close()


def test_a_frame_alone_is_journalled_without_waiting_for_more(folder, monkeypatch):
    committed, commit = threading.Event(), folder.commit

    def record(records: Any) -> None:
        commit(records)
        committed.set()

    monkeypatch.setattr(folder, "commit", record)
    writer = FrameWriter(folder, 32)
    writer.put(shot(STEPS[0]))
    assert committed.wait(10)
    assert folder.counts() == (1, 0)
    writer.close()
    folder.close()


def test_many_frames_share_their_flushes(folder, monkeypatch):
    batches: list[int] = []
    commit, store, all_put = folder.commit, folder.store_frame, threading.Event()

    def counted(records: Any) -> None:
        batches.append(len(records))
        commit(records)

    def held(*args: Any, **more: Any) -> Any:
        assert all_put.wait(10)
        return store(*args, **more)

    monkeypatch.setattr(folder, "commit", counted)
    monkeypatch.setattr(folder, "store_frame", held)
    writer = FrameWriter(folder, 20)
    for step in STEPS:
        writer.put(shot(step))
    all_put.set()
    writer.close()
    assert sum(batches) == 20
    assert len(batches) <= 6
    folder.close()


def test_put_keeps_raising_after_an_error(folder, monkeypatch):
    def full(*_args: Any, **_more: Any) -> Any:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(folder, "store_frame", full)
    writer = FrameWriter(folder, 1)
    writer.put(shot(STEPS[0]))
    for step in STEPS[1:4]:
        with pytest.raises(OSError, match="No space left"):
            writer.put(shot(step))
    with pytest.raises(OSError, match="No space left"):
        writer.close()
    folder.close()
