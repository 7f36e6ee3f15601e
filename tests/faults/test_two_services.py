"""A second service on a stage: the first one's capture goes on, and the second says who has it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from waiting import until

from stage_service.captures.manager import CaptureManager
from stage_service.config import RigFile
from stage_service.devices import ownership
from stage_service.devices.ownership import StageInUse
from stage_service.plan.capture_plan import CapturePlan
from stage_service.records.lease import FileLock

Begin = Callable[..., CaptureManager]


@pytest.fixture
def begin(tmp_path: Path) -> Iterator[Begin]:
    """`begin(rig_file, root, …)`: a service as it starts; all are closed."""
    with ExitStack() as stack:

        def start(rig_file: RigFile, root: str, **more: Any) -> CaptureManager:
            manager = CaptureManager(rig_file, tmp_path / root, **more)
            stack.callback(manager.close)
            try:
                manager.stage.take()
            except StageInUse:
                manager.close()
                raise
            manager.stage.darken()
            return manager

        yield start


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[str], None]:
    """`elsewhere(host)`: what is made from now on is made on that machine."""

    def move(host: str) -> None:
        (tmp_path / host).mkdir(exist_ok=True)
        monkeypatch.setattr(ownership.socket, "gethostname", lambda: host)
        monkeypatch.setattr(ownership, "_folder", lambda: tmp_path / host)

    return move


def other_serial_ports(rig_file: RigFile) -> RigFile:
    """Serial ports cannot be opened twice: only over TCP does a second service get as far."""
    assert rig_file.devices is not None
    return replace(rig_file, devices=rig_file.devices.model_copy(update={"projectors": None}))


def test_a_second_service_says_who_has_the_stage_and_darkens_nothing(
    simulated, begin, elsewhere, tmp_path
):
    rig_file, world = simulated()
    elsewhere("left")
    first = begin(rig_file, "one")
    world.lamps.select(5)
    for host, said in (("left", r"root .*/one"), ("right", "held by left:")):
        elsewhere(host)
        with pytest.raises(StageInUse, match=said):
            begin(other_serial_ports(rig_file), host)
    assert world.lamps.power().any()
    world.lamps.select(0)
    capture = first.start(CapturePlan(projectors=()))
    with pytest.raises(StageInUse, match="held by left:"):
        begin(other_serial_ports(rig_file), "two")
    assert first.wait(capture, 60).outcome == "completed"
    first.close()
    begin(rig_file, "two").close()


def test_machines_whose_names_begin_alike_are_not_one(simulated, begin, elsewhere):
    rig_file, _ = simulated()
    elsewhere("hairstage-studio-control-1.example.org")
    begin(rig_file, "one")
    elsewhere("hairstage-studio-control-2.example.org")
    with pytest.raises(StageInUse, match="held by hairstage-studi"):
        begin(other_serial_ports(rig_file), "two")


def test_a_dead_machine_keeps_the_stage_until_a_person_releases_it(simulated, begin, elsewhere):
    rig_file, _ = simulated()
    elsewhere("left")
    dead = begin(rig_file, "one")
    elsewhere("right")
    with pytest.raises(StageInUse, match="--take-over"):
        begin(rig_file, "two")
    second = begin(rig_file, "three", take_over=True)
    # It was not dead: it lights nothing any more, and its end takes nothing from the other.
    with pytest.raises(StageInUse, match="held by right:"):
        dead.start(CapturePlan(projectors=()))
    dead.close()
    capture = second.start(CapturePlan(projectors=()))
    found = second.wait(capture, 60)
    assert found.outcome == "completed", found.error


def test_the_stage_of_a_killed_service_is_taken(simulated, begin, tmp_path):
    rig_file, _ = simulated()
    code = (
        "import os, sys; from pathlib import Path;"
        "from stage_service.captures.manager import CaptureManager;"
        "from stage_service.config import load_rig_file;"
        "one = CaptureManager(load_rig_file(*sys.argv[1:3]), Path(sys.argv[3]));"
        "one.stage.take(); os.kill(os.getpid(), 9)"
    )
    devices = rig_file.path.with_suffix("") / "devices.toml"
    command = [sys.executable, "-c", code, rig_file.path, devices, tmp_path / "killed"]
    assert subprocess.run(command).returncode == -9
    begin(rig_file, "other")


def test_a_bank_that_was_switched_off_is_queried_again(simulated, begin):
    rig_file, world = simulated()
    first = begin(rig_file, "one")
    world.lamps.own(0, [0])
    world.lamps.own(0, [9, 0x6162])
    with pytest.raises(StageInUse, match="held by ab"):
        first.start(CapturePlan(projectors=()))
    world.lamps.own(0, [0])
    capture = first.start(CapturePlan(projectors=()))
    assert first.wait(capture, 60).outcome == "completed"
    assert world.lamps.owner()[0] not in (0, 9)
    first.close()
    assert world.lamps.owner() == 17 * [0]


def test_a_lock_leaves_no_file_behind(tmp_path):
    path = tmp_path / "lock"
    FileLock(path, "one").release()
    assert not path.exists()
    first = FileLock(path, "one", shared=True)
    assert path.stat().st_mode & 0o777 == 0o666
    with pytest.raises(OSError, match=r"^one$"):
        FileLock(path, "two", shared=True)
    first.release()
    FileLock(path, "two").release()


def test_a_capture_ends_where_the_bank_was_started_anew(simulated, begin):
    """Its levels are full from then on, and no link broke that would say so."""
    rig_file, world = simulated()
    service = begin(rig_file, "root")
    capture = service.start(CapturePlan(projectors=(), exposure={"olat": 0.5}))
    until(lambda: world.lamps.power().any())
    world.lamps.own(0, [0])
    found = service.wait(capture, 60)
    assert found.outcome == "failed"
    assert "received no owner" in str(found.error)
    assert not world.lamps.power().any()
