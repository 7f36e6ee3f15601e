"""A disk that is really full: a file system of 40 MB in a name space of its own."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from disks import on_small_disk, require_small_disk

SCRIPT = Path(__file__).with_name("full_disk.py")

LOCKED = """
import sys
from pathlib import Path
from stage_service.records.lease import RootInUse, RootLock

folder = Path(sys.argv[1])
with (folder / "filler").open("wb", buffering=0) as filler:
    try:
        while filler.write(bytes(4096)):
            pass
    except OSError:
        pass
lock = RootLock(folder)
try:
    RootLock(folder)
except RootInUse:
    print("refused")
lock.release()
RootLock(folder).release()
"""


def shoot(folder: Path, reserve: int) -> dict[str, Any]:
    require_small_disk(folder)
    done = on_small_disk(folder, sys.executable, str(SCRIPT), str(folder), str(reserve))
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_a_disk_that_fills_up_ends_the_capture_and_costs_no_journalled_frame(tmp_path):
    out = shoot(tmp_path, reserve=0)
    assert "No space left on device" in out["error"]
    assert str(tmp_path / "capture") in out["error"]
    assert 0 < out["written"] < 120
    assert out["in_frames"] == out["written"]
    missing = 120 - out["written"]
    ended = "manifest.json is missing" if "finish" in out else "The capture's outcome is 'failed'"
    assert out["verify"][0].startswith(ended)
    assert out["verify"][1].startswith(f"{missing} planned frames were never captured")
    assert len(out["verify"]) == 2
    assert (out["resumed"], out["verify_resumed"], out["verify_compressed"]) == ("", [], [])


def test_the_capture_stops_while_there_is_still_room_to_finish_it(tmp_path):
    out = shoot(tmp_path, reserve=4 << 20)
    assert "233,472 bytes are needed and a reserve of 4,194,304" in out["error"]
    assert "finish" not in out
    assert out["verify"][0] == "The capture's outcome is 'failed', not 'completed'."
    assert len(out["verify"]) == 2
    assert 0 < out["written"] == out["in_frames"] < 120
    assert (out["resumed"], out["verify_resumed"], out["verify_compressed"]) == ("", [], [])


def test_a_full_disk_keeps_no_service_from_its_root_and_none_from_being_refused(tmp_path):
    """It darkens as it starts: that must not wait for somebody who makes room."""
    require_small_disk(tmp_path)
    done = on_small_disk(tmp_path, sys.executable, "-c", LOCKED, str(tmp_path))
    assert (done.returncode, done.stdout) == (0, "refused\n"), done.stderr
