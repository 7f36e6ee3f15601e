"""SIGTERM, whatever hangs: lamps off at once, and the process ends, with what it has left said."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest
from postgresql import Missing, PostgreSQL, running
from waiting import machine_slack, until

from simulators.peers.faults import Fault
from stage_service.stopping import STOP_S

CHECKOUT = Path(__file__).resolve().parents[2]
STANDING = ("-m", "benchmarks.service.standing_service")
WRITE = "reconstruction.files.durable:_write"
LIT = ("after stage_service.acquisition.exposing:Exposing._light", 6)
SOFTWARE = {"plan": {"stepping": "software"}}


class Process:
    """`hairstage serve` or `worker` in a process of its own; `told` is what it has logged."""

    def __init__(self, stack: ExitStack, log: Path, *words: object, **environment: str) -> None:
        self._log = log
        path = {"PYTHONPATH": f"{CHECKOUT}:{CHECKOUT / 'tests'}"}
        with log.open("w") as stderr:
            self.process = subprocess.Popen(
                [sys.executable, *map(str, words)],
                stdout=subprocess.PIPE,
                stderr=stderr,
                text=True,
                env={**os.environ, **path, **environment},
            )
        stack.callback(self._kill)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, self.told
        self.ready = json.loads(line)

    @property
    def told(self) -> str:
        return self._log.read_text()

    def stop(self) -> None:
        self.process.send_signal(signal.SIGTERM)

    def ended(self, code: int, *told: str) -> None:
        """It ends within what a stop takes at most, with this exit status and these words last.

        A machine on which it cannot even say that leaves the end to the kernel.
        """
        found = self.process.wait(STOP_S + 3.0 * machine_slack())
        if found == -signal.SIGALRM and machine_slack() > 2:
            return
        assert found == code, self.told
        for text in told:
            assert re.search(text, self.told), self.told

    def _kill(self) -> None:
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as one:
        yield one


@pytest.fixture
def serve(stack, tmp_path):
    """`serve(rig_file, standing=(place, call), **environment)`: a service and its client."""

    def start(rig_file, standing=None, **environment):
        words = ["serve", "--json", "--no-auth", "--port", "0", "--rig", rig_file.path]
        words += ["--devices", rig_file.path.with_suffix("") / "devices.toml"]
        words += ["--root", tmp_path / "root"]
        program = ("-m", "stage_service.cli")
        if standing is not None:
            program = (*STANDING, tmp_path, *standing)
        service = Process(stack, tmp_path / "serve.log", *program, *words, **environment)
        client = httpx.Client(base_url=service.ready["url"], timeout=60, trust_env=False)
        return service, stack.enter_context(client)

    return start


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
    stage, serve, postgresql, stack, tmp_path
):
    """F15: its server takes connections and requests, and answers none."""
    rig_file, world = stage
    database = {"HAIRSTAGE_DATABASE_URL": postgresql.url}
    service, client = serve(rig_file, **database)
    assert client.get("/jobs").status_code == 200
    worker = Process(
        stack,
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
            for process in (service, worker):
                process.ended(1, "after it was to stop; not ended: the job database")
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
    assert "Traceback" not in service.told
    assert not is_lit(world)
