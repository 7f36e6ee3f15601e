"""SIGTERM, whatever hangs: lamps off at once, and the process ends, with what it has left said."""

from __future__ import annotations

import json
import socket

import pytest
from postgresql import Missing, PostgreSQL, running
from waiting import until

from simulators.peers.faults import Fault

WRITE = "reconstruction.files.durable:_write"
LIT = ("after stage_service.acquisition.exposing:Exposing._light", 6)
SOFTWARE = {"plan": {"stepping": "software"}}


@pytest.fixture
def postgresql(stack, tmp_path) -> PostgreSQL:
    try:
        return stack.enter_context(running())
    except Missing as error:
        pytest.skip(str(error))


@pytest.fixture
def stage(simulated, small_rig):
    """A rig file and the world behind it; each lamp is lit for long enough to be found so."""
    return simulated(rig=small_rig.replace("olat = 0.002", "olat = 2.0"))


def is_lit(world) -> bool:
    return bool(world.lamps.power().any())


def test_a_job_database_that_is_frozen_keeps_nobody_from_ending(
    process, stage, serve, postgresql, stack, tmp_path
):
    """F15: its server takes connections and requests, and answers none."""
    rig_file, world = stage
    database = {"HAIRSTAGE_DATABASE_URL": postgresql.url}
    service, client = serve(rig_file, **database)
    assert client.get("/jobs").status_code == 200
    worker = process(
        tmp_path / "worker.log",
        *("-m", "stage_service.cli", "worker", "--json", "--root", tmp_path / "root"),
        **database,
    )
    postgresql.freeze()
    try:
        with socket.create_connection(
            (client.base_url.host, client.base_url.port)
        ) as waiting:  # a request that is never answered, and keeps a thread
            waiting.sendall(b"GET /jobs HTTP/1.1\r\nHost: localhost\r\n\r\n")
            capture = client.post("/captures", json=SOFTWARE).json()["id"]
            until(lambda: is_lit(world))
            service.stop()
            worker.stop()
            until(lambda: not is_lit(world))
            for one in (service, worker):
                one.ended(None)  # 1 where the database still had not ended
    finally:
        postgresql.thaw()
    manifest = tmp_path / "root" / "captures" / capture / "manifest.json"
    assert json.loads(manifest.read_text())["outcome"] == "aborted"


def test_a_disk_that_hangs_keeps_nobody_from_ending(stage, serve, tmp_path):
    rig_file, world = stage
    service, client = serve(rig_file, standing=(WRITE, 9))
    (tmp_path / "armed").touch()
    # The first frame's.
    client.post("/captures", json=SOFTWARE)
    until((tmp_path / "here").exists)
    service.stop()
    until(lambda: not is_lit(world))
    hangs = "lamps and capture: (capture .* hangs: its folder is not finished|not ended within)"
    service.ended(1, hangs, "not ended: lamps and capture")
    assert not is_lit(world)


def test_a_light_bank_that_hangs_keeps_nobody_from_ending(stage, serve, tmp_path):
    """With a lamp lit, and the capture's thread stuck: its watchdog darkens, the latch is kept."""
    rig_file, world = stage
    service, client = serve(rig_file, standing=LIT)
    (tmp_path / "armed").touch()
    client.post("/captures", json=SOFTWARE)
    until(lambda: (tmp_path / "here").exists() and is_lit(world))
    world.faults.add(Fault("lights", "hang", 0))
    service.stop()
    until(lambda: not is_lit(world))
    hangs = "lamps and capture: (capture .* hangs: its folder is not finished|not ended within)"
    service.ended(1, hangs, "not ended: lamps and capture")
    latched = json.loads((tmp_path / "root" / "unsafe.json").read_text())
    assert "light bank" in latched["detail"]


def test_requests_that_go_on_are_cut_off(stage, serve, tmp_path):
    """An event stream, an archive that nobody reads, and a request that is stuck in its thread."""
    rig_file, world = stage
    stuck = "after stage_service.service:Service.rig"
    service, client = serve(rig_file, standing=(stuck, 1))
    (tmp_path / "armed").touch()
    address = (client.base_url.host, client.base_url.port)
    with socket.create_connection(address) as rig, client.stream("GET", "/events") as events:
        assert events.status_code == 200
        rig.sendall(b"GET /rig HTTP/1.1\r\nHost: localhost\r\n\r\n")
        until((tmp_path / "here").exists)
        service.stop()
        service.ended(0, r"after it was to stop; not ended: \d requests$")
    assert "Traceback" not in service.log
    assert not is_lit(world)
