"""Capture folders: written, torn, damaged, compressed."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import threading
from dataclasses import replace
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
    Mesh,
    MissingFrame,
    Rig,
    Step,
    verify,
)
from reconstruction.capture import compression
from reconstruction.capture import writer as capture_writer
from reconstruction.capture.compression import compress
from reconstruction.files import durable
from reconstruction.files.durable import DiskFull

RIG = Rig(
    "two",
    tuple(Camera.look_at(f"cam_{i}", 8, 6, [i - 0.5, -1, 0], [0, 0, 0], 20) for i in range(2)),
    tuple(Light(f"light_{i}", np.array([i, 1, 1]), np.ones(3)) for i in range(2)),
)
STEPS = (
    Step(0, "dark", 0.01, 0.0),
    Step(1, "olat", 0.01, 0.5, light="light_0"),
    Step(2, "olat", 0.01, 0.5, light="light_1"),
)
HEAD = Mesh(np.eye(3), np.array([[0, 1, 2]]), np.array([True]))


def image(step: Step, camera: str) -> np.ndarray:
    rng = np.random.default_rng([step.index, int(camera[-1])])
    return rng.normal(1.0, 0.5, (6, 8, 3)).astype(np.float32)


def write(writer: CaptureWriter, *keys: tuple[int, str]) -> None:
    for index, camera in keys:
        step = STEPS[index]
        frame = image(step, camera)
        record = writer.store_frame(step, camera, frame, full_scale=4.0, count_scale=1e-3)
        writer.commit([replace(record, pulse=index + 1)])


EVERY = [(s.index, c.name) for s in STEPS for c in RIG.cameras]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A sound, finished capture."""
    masks = {"cam_0": np.eye(6, 8, dtype=bool)}
    writer = CaptureWriter.create(
        tmp_path / "c", RIG, {"steps": STEPS, "note": "kept"}, masks=masks, head=HEAD
    )
    write(writer, *EVERY)
    writer.finish("completed", {"seconds": 1.5})
    return tmp_path / "c"


def test_a_written_capture_reads_back_exactly(path):
    capture = Capture(path)
    assert verify(path) == []
    assert capture.steps == STEPS
    assert capture.plan["note"] == "kept"
    assert capture.manifest is not None
    assert capture.manifest["seconds"] == 1.5
    assert capture.manifest["frames"] == {"planned": 6, "written": 6, "missing": 0}
    for index, camera in EVERY:
        np.testing.assert_array_equal(
            capture.frame(STEPS[index], camera), image(STEPS[index], camera)
        )
    np.testing.assert_allclose(capture.response(STEPS[1], "cam_1"), 2 * image(STEPS[1], "cam_1"))
    np.testing.assert_array_equal(capture.mask("cam_0"), np.eye(6, 8, dtype=bool))
    assert capture.mask("cam_1") is None
    assert capture.head is not None
    np.testing.assert_array_equal(capture.head.scalp, [True])


@pytest.mark.parametrize("channel", range(3))
def test_saturation_is_read_from_the_header(tmp_path, channel):
    writer = CaptureWriter.create(tmp_path / "c", RIG, {"steps": STEPS})
    frame = np.full((6, 8, 3), 0.5, np.float32)
    frame[2, 3, channel] = np.float32(0.1) * np.float32(40)
    writer.write_frame(STEPS[1], "cam_0", frame, full_scale=4.0)
    writer.write_frame(STEPS[1], "cam_1", frame)
    writer.close()
    capture = Capture(tmp_path / "c")
    assert np.argwhere(capture.saturated(STEPS[1], "cam_0")).tolist() == [[2, 3]]
    assert not capture.saturated(STEPS[1], "cam_1").any()


def test_missing_frames_are_recorded_and_may_still_come(tmp_path):
    writer = CaptureWriter.create(tmp_path / "c", RIG, {"steps": STEPS})
    write(writer, *EVERY[:-1])
    writer.record_missing(STEPS[2], "cam_1", reason="no frame after 3 pulses", pulse=9)
    assert writer.missing() == [(STEPS[2], "cam_1")]
    writer.finish("completed", {})
    assert verify(tmp_path / "c") == ["Step 2 (olat), cam_1 is missing: no frame after 3 pulses."]
    with pytest.raises(MissingFrame, match="no frame after 3 pulses"):
        Capture(tmp_path / "c").frame(STEPS[2], "cam_1")
    again = CaptureWriter.reopen(tmp_path / "c")
    assert not (tmp_path / "c" / "manifest.json").exists()
    write(again, (2, "cam_1"))
    again.finish("completed", {})
    assert verify(tmp_path / "c") == []


def test_a_crash_in_the_journal_costs_the_torn_line_alone(tmp_path):
    writer = CaptureWriter.create(tmp_path / "c", RIG, {"steps": STEPS})
    write(writer, *EVERY[:4])
    writer.close()
    journal = tmp_path / "c" / "journal.jsonl"
    journal.write_bytes(journal.read_bytes()[:-20])
    assert len(Capture(tmp_path / "c").records) == 3
    problems = verify(tmp_path / "c")
    assert problems[0].startswith("journal.jsonl ends in an incomplete line")
    assert problems[1] == "manifest.json is missing: the capture was not finished."
    assert problems[2] == (
        "3 planned frames were never captured; the first is step 1 (olat), cam_1."
    )
    again = CaptureWriter.reopen(tmp_path / "c")
    assert again.missing() == [(STEPS[i], c) for i, c in EVERY[3:]]
    write(again, *EVERY[3:])
    again.finish("completed", {})
    assert verify(tmp_path / "c") == []


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("frames/00001/cam_0.exr", "frames/00001/cam_0.exr (step 1, cam_0) does not match"),
        ("head.obj", "head.obj does not match its checksum in the manifest."),
        ("masks/cam_0.png", "masks/cam_0.png does not match its checksum in the manifest."),
        ("plan.json", "plan.json does not match its checksum in the manifest."),
        ("journal.jsonl", "journal.jsonl does not match its checksum in the manifest."),
    ],
)
def test_one_changed_byte_is_found(path, name, problem):
    data = bytearray((path / name).read_bytes())
    # A blank becomes another blank, so that the text files stay readable.
    at = data.rfind(b" ") if name.endswith(("json", "jsonl", "obj")) else len(data) // 2
    data[at] = 9 if data[at] == 32 else data[at] ^ 1
    (path / name).write_bytes(data)
    (found,) = verify(path)
    assert found.startswith(problem)


def test_lost_and_unreadable_files_are_named(path):
    (path / "frames/00000/cam_1.exr").unlink()
    (path / "head.obj").unlink()
    journal = path / "journal.jsonl"
    broken = path / "frames/00002/cam_0.exr"
    broken.write_bytes(b"not an EXR")
    lines = [json.loads(line) for line in journal.read_text().splitlines()]
    from reconstruction.capture.writer import sha256

    for line in lines:
        if line["file"] == "frames/00002/cam_0.exr":
            line["sha256"] = sha256(broken)
    journal.write_text("".join(json.dumps(line) + "\n" for line in lines))
    problems = verify(path)
    assert "head.obj is missing; the manifest lists it." in problems
    assert any("00000/cam_1.exr (step 0, cam_1) is missing; the journal" in p for p in problems)
    assert any("00002/cam_0.exr (step 2, cam_0) does not decode" in p for p in problems)
    assert any(p.startswith("journal.jsonl does not match") for p in problems)


def test_verify_of_another_folder_gives_one_sentence(tmp_path):
    (problem,) = verify(tmp_path)
    assert "is not a capture: expected rig.json and plan.json" in problem


def test_compression_is_lossless_and_whole(path):
    before = {k: Capture(path).frame(STEPS[k[0]], k[1]) for k in EVERY}
    compress(path)
    assert verify(path) == []
    after = Capture(path)
    for key, frame in before.items():
        np.testing.assert_array_equal(after.frame(STEPS[key[0]], key[1]), frame)
        assert after.records[key].pulse == key[0] + 1
    assert not list(path.glob("frames/*/cam_?.exr"))
    assert compress(path) == 0


def test_compression_saves_bytes_and_survives_a_crash_between_frames(tmp_path, monkeypatch):
    rig = Rig("one", (Camera.look_at("cam_0", 200, 150, [0, -1, 0], [0, 0, 0], 20),), RIG.lights)
    writer = CaptureWriter.create(tmp_path / "c", rig, {"steps": STEPS})
    frame = np.zeros((150, 200, 3), np.float32)
    for step in STEPS:
        writer.write_frame(step, "cam_0", frame, full_scale=4.0)
    writer.finish("completed", {})

    class Crash(Exception):
        pass

    def crash(_what: str, share: float) -> None:
        if share > 0.5:
            raise Crash

    monkeypatch.setattr(compression, "TOGETHER", 1)
    with pytest.raises(Crash):
        compress(tmp_path / "c", crash)
    assert verify(tmp_path / "c") == []
    assert compress(tmp_path / "c") > 300_000
    assert verify(tmp_path / "c") == []
    assert Capture(tmp_path / "c").saturated(STEPS[0], "cam_0").sum() == 0


def test_compression_does_not_append_to_a_torn_line(path):
    with (path / "journal.jsonl").open("a") as journal:
        journal.write('{"step": 0, "cam')  # a full disk ended an earlier compression
    compress(path)
    assert verify(path) == []


def test_compression_does_not_bless_damage(path):
    frame = path / "frames/00001/cam_0.exr"
    data = bytearray(frame.read_bytes())
    data[-1] ^= 1
    frame.write_bytes(data)
    before = (path / "journal.jsonl").read_bytes()
    with pytest.raises(CaptureError, match="checksum"):
        compress(path)
    assert (path / "journal.jsonl").read_bytes() == before
    assert not list(path.glob("frames/*/*.zip.exr"))  # nothing that no line tells of


def test_two_compressions_side_by_side_do_every_frame_once(path):
    first_began, second_waits = threading.Event(), threading.Event()
    saved: list[int] = []

    def first(_what: str, _share: float) -> None:
        first_began.set()
        assert second_waits.wait(10)

    def second(what: str, _share: float) -> None:
        if "waiting" in what:
            second_waits.set()

    thread = threading.Thread(target=lambda: saved.append(compress(path, first)))
    thread.start()
    assert first_began.wait(10)
    assert compress(path, second) == 0
    thread.join(10)
    assert second_waits.is_set()
    assert len(saved) == 1
    assert verify(path) == []
    assert len((path / "journal.jsonl").read_text().splitlines()) == 2 * len(EVERY)


def test_a_reader_finds_a_frame_that_is_compressed_under_its_hands(path):
    capture, step = Capture(path), STEPS[1]
    expected = capture.read_file(step, "cam_1", Path.read_bytes)
    compress(path)
    np.testing.assert_array_equal(capture.frame(step, "cam_1"), image(step, "cam_1"))
    stale = Capture(path)
    new = stale.read_file(step, "cam_1", lambda file: file)
    assert new.name == "cam_1.zip.exr"
    assert new.read_bytes() != expected
    new.unlink()
    with pytest.raises(FileNotFoundError):  # lost for good: said, not looked for endlessly
        stale.read_file(step, "cam_1", Path.read_bytes)
    with pytest.raises(ValueError, match=r"cam_1\.zip\.exr: cannot be read"):
        stale.frame(step, "cam_1")


def test_leftovers_of_a_crash_before_removal_are_reported_and_removed(path):
    old = path / "frames/00001/cam_0.exr"
    before = old.read_bytes()
    compress(path)
    old.write_bytes(before)
    (path / "frames/00002/.part-cam_1.zip.exr").write_bytes(b"half")
    (problem,) = verify(path)
    assert problem.startswith("2 files under frames/ are not listed in the journal")
    assert problem.endswith("the first is frames/00001/cam_0.exr.")
    (path / "frames/00002/.part-cam_1.zip.exr").unlink()
    compress(path)
    assert not old.exists()
    assert verify(path) == []


def test_verify_during_a_compression_finds_nothing_wrong(path):
    found: list[list[str]] = []
    compress(path, lambda _what, _share: found.append(verify(path)))
    assert found == [[]] * -(-len(EVERY) // compression.TOGETHER)


def test_a_capture_has_one_writer(tmp_path):
    writer = CaptureWriter.create(tmp_path / "c", RIG, {"steps": STEPS})
    with pytest.raises(CaptureError, match="it is being written or compressed"):
        CaptureWriter.reopen(tmp_path / "c")
    write(writer, *EVERY)
    writer.close()
    writer = CaptureWriter.reopen(tmp_path / "c")
    assert writer.missing() == []
    writer.close()


def test_stored_frames_count_only_once_they_are_committed(tmp_path):
    writer = CaptureWriter.create(tmp_path / "c", RIG, {"steps": STEPS})
    records = [writer.store_frame(STEPS[i], c, image(STEPS[i], c)) for i, c in EVERY[:4]]
    assert not list((tmp_path / "c").glob("frames/*/cam_?.exr"))
    writer.commit(records[:3])
    assert verify(tmp_path / "c")[1:] == [
        "3 planned frames were never captured; the first is step 1 (olat), cam_1."
    ]
    writer.close()
    assert len(list((tmp_path / "c").glob("frames/*/*"))) == 3


@pytest.mark.parametrize("direct", [True, False], ids=["past the cache", "through the cache"])
def test_frames_are_flushed_before_their_journal_lines(tmp_path, monkeypatch, direct):
    """One flush of the whole disk for six files, or one a file where pages may be in a cache."""
    writer = CaptureWriter.create(tmp_path / "c", RIG, {"steps": STEPS})
    wrote: Any = durable.write_pages
    messages: list[str] = []
    # As a file system says that has direct input and output, or has none.
    monkeypatch.setattr(capture_writer, "write_pages", lambda p, d: (wrote(p, d), direct)[1])
    records = [writer.store_frame(STEPS[i], c, image(STEPS[i], c)) for i, c in EVERY]
    whole, each = durable.FileSystem.flush, os.fsync
    rename, append = Path.replace, durable.append_whole

    def fsync(handle: int) -> None:
        messages.append(Path(f"/proc/self/fd/{handle}").resolve().name)
        each(handle)

    def all_of_it(disk: durable.FileSystem) -> None:
        messages.append("disk")
        whole(disk)

    def renamed(old: Path, new: Path) -> Path:
        messages.append(new.name)
        return rename(old, new)

    def appended(file: Any, data: bytes) -> None:
        messages.append("line")
        append(file, data)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(durable.FileSystem, "flush", all_of_it)
    monkeypatch.setattr(Path, "replace", renamed)
    monkeypatch.setattr(capture_writer, "append_whole", appended)
    writer.commit(records)
    names = [f"{camera}.exr" for _, camera in EVERY]
    if direct:
        assert messages == [*names, "disk", "line", "journal.jsonl"]
    else:
        files = [x for name in names for x in (f".part-{name}", name)]
        assert messages[:12] == files
        assert sorted(messages[12:-2]) == ["00000", "00001", "00002", "frames"]
        assert messages[-2:] == ["line", "journal.jsonl"]
    writer.finish("completed")
    assert verify(tmp_path / "c") == []


KILLED = """
import sys, os, signal
import numpy as np
from reconstruction.capture.writer import CaptureWriter
writer = CaptureWriter.reopen(sys.argv[1])
for n, (step, camera) in enumerate(writer.missing()):
    record = writer.store_frame(step, camera, np.full((6, 8, 3), n, np.float32))
    if n == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    writer.commit([record])
"""


def test_a_killed_writer_costs_the_frame_under_way(tmp_path):
    path = tmp_path / "c"
    CaptureWriter.create(path, RIG, {"steps": STEPS}).close()
    subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False)
    assert verify(path) == [
        "manifest.json is missing: the capture was not finished.",
        "3 planned frames were never captured; the first is step 1 (olat), cam_1.",
        "1 files under frames/ are not listed in the journal, as after an interrupted write or "
        "compression; the first is frames/00001/.part-cam_1.exr.",
    ]
    again = CaptureWriter.reopen(path)
    write(again, *EVERY[3:])
    again.finish("completed")
    assert verify(path) == []


def test_a_frame_that_a_power_cut_left_torn_is_none_of_the_capture(tmp_path):
    """It has its name, and no line: the disk lost power before both were on it."""
    path = tmp_path / "c"
    writer = CaptureWriter.create(path, RIG, {"steps": STEPS})
    write(writer, *EVERY[:3])
    writer.close()
    torn = path / "frames/00001/cam_1.exr"
    torn.write_bytes(bytes(100))
    note = path / "frames/00001/note.txt"
    note.write_text("the user's own")
    assert not Capture(path).has(STEPS[1], "cam_1")
    again = CaptureWriter.reopen(path)
    assert not torn.exists()
    assert note.read_text() == "the user's own"
    note.unlink()
    write(again, *EVERY[3:])
    again.finish("completed")
    assert verify(path) == []


def test_a_frame_that_finds_the_disk_full_is_an_error_and_no_frame(tmp_path):
    writer = CaptureWriter.create(tmp_path / "c", RIG, {"steps": STEPS})
    write(writer, EVERY[0])
    (tmp_path / "c/frames/00000/.part-cam_1.exr").symlink_to("/dev/full")
    with pytest.raises(DiskFull, match=r"bytes are needed.* are free.*part-cam_1\.exr") as error:
        write(writer, EVERY[1])
    assert error.value.errno == errno.ENOSPC
    manifest = writer.finish("failed", {"error": str(error.value)})
    assert manifest["frames"] == {"planned": 6, "written": 1, "missing": 5}
    assert verify(tmp_path / "c") == [
        "The capture's outcome is 'failed', not 'completed'.",
        "5 planned frames were never captured; the first is step 0 (dark), cam_1.",
    ]


def test_a_journal_that_finds_the_disk_full_names_no_frame_that_is_not_whole(tmp_path):
    writer = CaptureWriter.create(tmp_path / "c", RIG, {"steps": STEPS})
    write(writer, EVERY[0])
    with Path("/dev/full").open("ab", buffering=0) as full:
        journal, writer._journal = writer._journal, full
        with pytest.raises(DiskFull, match="/dev/full"):
            write(writer, EVERY[1])
        writer._journal = journal
    write(writer, EVERY[1])  # room was made
    writer.close()
    assert len(Capture(tmp_path / "c").records) == 2


def test_the_reserve_stays_free(tmp_path):
    writer = CaptureWriter.create(tmp_path / "c", RIG, {"steps": STEPS})
    writer.reserve = 1 << 60
    with pytest.raises(DiskFull, match=r"a reserve of 1,152,921,504,606,846,976, [0-9,]+ are free"):
        write(writer, EVERY[0])
    writer.finish("failed")
    assert not list((tmp_path / "c/frames").iterdir())


def test_bad_input_is_named(tmp_path):
    with pytest.raises(CaptureError, match="'steps' is missing"):
        CaptureWriter.create(tmp_path / "a", RIG, {})
    with pytest.raises(CaptureError, match=r"duplicate step indices \[1\]"):
        CaptureWriter.create(tmp_path / "a", RIG, {"steps": [STEPS[1], STEPS[1]]})
    with pytest.raises(CaptureError, match="mask of cam_0: expected shape"):
        CaptureWriter.create(
            tmp_path / "a", RIG, {"steps": STEPS}, masks={"cam_0": np.ones((8, 6), bool)}
        )
    assert not (tmp_path / "a").exists()
    writer = CaptureWriter.create(tmp_path / "a", RIG, {"steps": STEPS})
    with pytest.raises(CaptureError, match="new or empty folder"):
        CaptureWriter.create(tmp_path / "a", RIG, {"steps": STEPS})
    good = image(STEPS[0], "cam_0")
    with pytest.raises(CaptureError, match=r"expected an image \(6, 8, 3\)"):
        writer.write_frame(STEPS[0], "cam_0", good[:5])
    with pytest.raises(CaptureError, match="not finite"):
        writer.write_frame(STEPS[0], "cam_0", good * np.nan)
    with pytest.raises(CaptureError, match="not in this capture's plan"):
        writer.write_frame(Step(0, "dark", 0.5, 0.0), "cam_0", good)
    with pytest.raises(KeyError, match="no camera 'cam_7'"):
        writer.write_frame(STEPS[0], "cam_7", good)
    writer.write_frame(STEPS[0], "cam_0", good)
    with pytest.raises(CaptureError, match="already written"):
        writer.write_frame(STEPS[0], "cam_0", good)
    writer.close()
