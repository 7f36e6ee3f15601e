"""Whatever the service is busy with: lights can be put off, and it starts again."""

from __future__ import annotations

import json
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path, PosixPath
from typing import Any

import httpx
import pytest
from serving import Client, serving
from waiting import until

from reconstruction import CaptureWriter, Step
from stage_service import watching
from stage_service.api.gate import Access
from stage_service.api.places import LIMITS
from stage_service.captures import control, light_control, status_index
from stage_service.captures.catalogue import Catalogue
from stage_service.devices.lights.modbus import ModbusLightBank
from stage_service.jobs.slots import WorkerSlot
from stage_service.records.tokens import Tokens
from stage_service.service_models import CaptureRequest

THREADS = 45
"""More than may be at work at once, and more than the 40 that the framework has."""
LONG = {"plan": {"projectors": []}}
SHORT = {"plan": {"lights": ["light_003"], "projectors": []}}


def flood(http: Client, *request: Any, count: int = THREADS, **more: Any) -> None:
    """Send a request so many times at once, and wait for no answer."""

    def start_capture() -> None:
        own = httpx.Client(base_url=http.base_url, timeout=120, trust_env=False)
        with own, suppress(httpx.HTTPError):
            own.request(*request, **more)

    for _ in range(count):
        threading.Thread(target=start_capture, daemon=True).start()


@contextmanager
def stuck(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str) -> Iterator[Callable[[], int]]:
    """Whoever calls this waits until the end of the block; how many do."""
    free, waiting = threading.Event(), []
    real = getattr(owner, name)

    def instead(*args: Any, **more: Any) -> Any:
        if not free.is_set():
            waiting.append(1)
            free.wait()
        return real(*args, **more)

    monkeypatch.setattr(owner, name, instead)
    try:
        yield lambda: len(waiting)
    finally:
        free.set()


def begun(http: Client, world: Any) -> str:
    """The id of a capture that has lit its first lamps."""
    capture: str = http.post("/captures", json=LONG).json()["id"]
    until(lambda: world.pulses > 3)
    return capture


def assert_it_can_be_darkened(http: Client, world: Any, capture: str | None) -> None:
    """Health, abort and blackout are answered, and the blackout says the truth."""
    assert http.get("/health").status_code == 200
    if capture is not None:
        assert http.post(f"/captures/{capture}/abort").status_code in (200, 409)
    response = http.post("/devices/blackout").json()
    assert (response["state"], world.lit, world.show) == ("dark", set(), "OFF")


def test_while_every_request_that_may_be_at_work_waits(rig_file, world, tmp_path, monkeypatch):
    with (
        serving(rig_file, tmp_path) as http,
        stuck(monkeypatch, http.service, "validate") as waiting,
    ):
        flood(http, "POST", "/plans:validate", json={})
        until(lambda: waiting() == LIMITS["requests"].steering)
        request = CaptureRequest.model_validate(LONG)
        capture = http.service.start_capture(request, control.Caller("here")).id
        until(lambda: world.pulses > 3)
        assert_it_can_be_darkened(http, world, capture)


def test_while_the_job_database_never_responds(rig_file, world, tmp_path, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        url = f"postgresql://nobody@127.0.0.1:{deaf.getsockname()[1]}/x?connect_timeout=600"
        monkeypatch.setenv("HAIRSTAGE_DATABASE_URL", url)
        monkeypatch.setattr("stage_service.api.lanes.DATABASE_S", 1.0)
        with serving(rig_file, tmp_path) as http:
            capture = begun(http, world)
            flood(http, "GET", "/jobs")
            problem = http.get("/jobs").json()
            assert problem["type"] == "/docs/errors.md#jobs-unavailable"
            assert_it_can_be_darkened(http, world, capture)
            until(lambda: http.get(f"/captures/{capture}").json()["state"] == "done")
            assert [c["id"] for c in http.get("/captures").json()] == [capture]
        deaf.close()


def test_while_cameras_hang_and_many_clients_query_the_devices(rig_file, world, tmp_path):
    assert rig_file.devices is not None
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        port = deaf.getsockname()[1]
        cameras = rig_file.devices.cameras.model_copy(update={"port": port, "timeout_s": 600.0})
        devices = rig_file.devices.model_copy(update={"cameras": cameras})
        with serving(replace(rig_file, devices=devices), tmp_path) as http:
            flood(http, "GET", "/devices")
            observed = http.get("/devices").json()
            assert observed["age_s"] is None
            assert observed["cameras"]["cam_0"]["state"] == "not queried yet"
            world.lit = {3}
            assert_it_can_be_darkened(http, world, None)


def test_while_the_lights_hang_blackout_reports_it_and_darkens_the_projectors(
    rig_file, world, tmp_path, monkeypatch
):
    with serving(rig_file, tmp_path) as http:
        assert http.get("/devices").json()["safety"]["state"] == "dark"
        world.show = "ON 65535"
        with stuck_lights(world):
            flood(http, "GET", "/devices", count=5)
            monkeypatch.setattr(light_control, "LATE_AFTER_S", 0.0)
            flood(http, "POST", "/devices/blackout", count=1)
            until(lambda: http.get("/health").json()["lamps"] == "unknown, unsafe")
            events = http.service.events.after
            until(lambda: any("under way" in str(e.data) for e in events(0, 99)))
            response = http.post("/devices/blackout").json()
            assert response["state"] == "unknown, unsafe"
            assert "light bank" in response["detail"]
            kinds = [e.kind for e in events(0, 99) if "unknown" in str(e.data)]
            assert kinds.index("stage.lamps") < kinds.index("stage.blackout"), "told before it ends"
            assert world.show == "OFF"
            health = http.get("/health").json()
            assert (health["status"], health["lamps"]) == ("unsafe", "unknown, unsafe")
        assert_it_can_be_darkened(http, world, None)
        assert http.get("/health").json()["status"] == "ok"


def test_hanging_devices_delay_no_blackout(rig_file, world, tmp_path, monkeypatch):
    """The answer is "unknown, unsafe"; what it comes to in the end is told, and recorded."""
    with serving(rig_file, tmp_path) as http:
        monkeypatch.setattr(control, "REPLY_S", 0.0)
        with stuck(monkeypatch, ModbusLightBank, "off") as waiting:
            for _ in range(3 * control.MOST_BLACKOUTS):
                response = http.post("/devices/blackout").json()
                assert (response["safe"], response["state"]) == (False, "unknown, unsafe")
                assert "continues" in response["detail"]
            assert 0 < waiting() <= control.MOST_BLACKOUTS
            assert http.get("/health").json()["lamps"] == "unknown, unsafe"
        until(lambda: http.get("/health").json()["lamps"] == "dark")
        ended = [
            e.data["state"] for e in http.service.events.after(0, 99) if e.kind == "stage.blackout"
        ]
        assert ended[-1] == "dark"
        assert "dark" in [
            a["result"] for a in http.get("/audit").json() if a["action"] == "blackout"
        ]


def test_projectors_go_dark_while_the_run_waits_for_a_lamp(rig_file, world, tmp_path, monkeypatch):
    """Not one deadline after another: that of the lamp first, then that of the blackout."""
    monkeypatch.setattr(light_control, "GIVEN_UP_S", 3600.0)
    with serving(rig_file, tmp_path) as http:
        with stuck(monkeypatch, ModbusLightBank, "select") as waiting:
            http.post("/captures", json=LONG)
            until(lambda: waiting() > 0)
            world.show = "ON 65535"
            flood(http, "POST", "/devices/blackout", count=1)
            until(lambda: world.show == "OFF")
        assert_it_can_be_darkened(http, world, None)


@contextmanager
def stuck_lights(world: Any) -> Iterator[None]:
    """The light bank takes requests and answers none."""
    world.deaf_lights = True
    try:
        yield
    finally:
        world.deaf_lights = False


def test_while_the_disk_hangs(rig_file, world, tmp_path, monkeypatch):
    """A run that cannot hand over its frames does not end, and is darkened all the same."""
    with (
        serving(rig_file, tmp_path) as http,
        stuck(monkeypatch, CaptureWriter, "commit") as waiting,
    ):
        capture = http.post("/captures", json=LONG).json()["id"]
        until(lambda: waiting() > 0)
        world.lit = {5}
        start = time.monotonic()
        assert_it_can_be_darkened(http, world, capture)
        assert http.get(f"/captures/{capture}").json()["state"] != "done"
        assert http.post("/captures", json=LONG).status_code == 409
        assert time.monotonic() - start < light_control.STOP_WITHIN_S


class Slow(PosixPath):
    """A path on a disk that does not answer until it is `there`."""

    there = threading.Event()

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        self.there.wait()
        return super().stat(follow_symlinks=follow_symlinks)


def test_no_request_waits_for_a_hanging_token_file(rig_file, world, tmp_path):
    """One request with a token of the file must not keep another from a blackout."""
    Slow.there.set()
    tokens = Tokens(Slow(tmp_path / "tokens.json"), own="mine")
    hers = {"Authorization": f"Bearer {tokens.make('ada', ('read',))}"}
    with serving(rig_file, tmp_path, Access(tokens)) as http:
        assert http.get("/health", headers=hers).json()["lamps"] == "dark"
        Slow.there.clear()
        try:
            flood(http, "GET", "/health", count=1, headers=hers)
            assert http.get("/health", headers=hers, timeout=10).status_code == 200
            mine = {"Authorization": "Bearer mine"}
            world.lit = {5}
            response = http.post("/devices/blackout", headers=mine, timeout=10).json()
            assert (response["state"], world.lit) == ("dark", set())
        finally:
            Slow.there.set()
        tokens.revoke("ada")
        until(lambda: http.get("/health", headers=hers).status_code == 401)


def test_health_responds_while_the_root_folder_s_disk_hangs(rig_file, tmp_path, monkeypatch):
    monkeypatch.setattr(watching, "SILENT_S", 0.0)
    slot = WorkerSlot(tmp_path)
    with serving(rig_file, tmp_path) as http:
        until(lambda: http.get("/health").json()["worker"])
        with stuck(monkeypatch, Path, "glob") as waiting:
            health = http.get("/health").json()
            assert waiting() > 0
            assert (health["worker"], health["disk_free_bytes"]) == (True, None)  # as last seen
    slot.release()


def test_a_blackout_that_fails_because_of_a_hanging_run_is_reported(
    rig_file, world, tmp_path, monkeypatch
):
    with (
        serving(rig_file, tmp_path) as http,
        stuck(monkeypatch, CaptureWriter, "commit") as waiting,
    ):
        http.post("/captures", json=LONG)
        until(lambda: waiting() > 0)
        world.lit, world.stuck_lamps = {5}, True
        assert http.post("/devices/blackout").json()["state"] == "unknown, unsafe"
        health = http.get("/health").json()
        assert health["capture"] is not None, "it hangs"
        assert (health["status"], health["lamps"]) == ("unsafe", "unknown, unsafe")
        assert health["problems"][0] == health["latch"]["detail"]
        assert http.get("/devices").json()["safety"]["latched"] == health["latch"]["since"]
        assert http.get("/ready").status_code == 503
        world.stuck_lamps = False


@contextmanager
def finishing(
    http: Client, world: Any, monkeypatch: pytest.MonkeyPatch, *, dark: bool
) -> Iterator[str]:
    """The id of a capture that hangs on the disk after its own last blackout, which came to dark
    or not; goes on after it, to its end."""
    world.stuck_lamps = not dark
    with stuck(monkeypatch, CaptureWriter, "finish") as waiting:
        capture: str = http.post("/captures", json=SHORT).json()["id"]
        until(waiting)
        yield capture
    until(lambda: http.get("/health").json()["capture"] is None)


def test_over_a_run_that_hangs_after_its_own_blackout_another_one_is_made(
    rig_file, world, tmp_path, monkeypatch
):
    """What was dark then may be lit now; and what has come to light since is not forgotten when
    the run goes on."""
    with serving(rig_file, tmp_path) as http:
        with finishing(http, world, monkeypatch, dark=True) as capture:
            for lamp in (5, 6):
                world.lit, world.show = {lamp}, "ON 65535"
                assert_it_can_be_darkened(http, world, capture)
            world.lit, world.stuck_lamps = {7}, True
            assert http.post("/devices/blackout").json()["state"] == "unknown, unsafe"
        ended = http.get(f"/captures/{capture}").json()
        assert (ended["state"], ended["outcome"]) == ("done", "completed")
        assert http.get("/health").json()["status"] == "unsafe", "its end says nothing newer"
        world.stuck_lamps = False
        assert_it_can_be_darkened(http, world, None)


def test_a_blackout_that_failed_at_a_run_s_end_is_not_repeated_when_all_is_well(
    rig_file, world, tmp_path, monkeypatch
):
    with serving(rig_file, tmp_path) as http:
        with finishing(http, world, monkeypatch, dark=False) as capture:
            assert http.post("/devices/blackout").json()["state"] == "unknown, unsafe"
            assert http.get("/health").json()["status"] == "unsafe"
            world.stuck_lamps = False
            assert_it_can_be_darkened(http, world, capture)
            assert http.get("/health").json()["status"] == "ok"
        assert http.get(f"/captures/{capture}").json()["outcome"] == "failed"
        health = http.get("/health").json()
        assert (health["status"], health["lamps"]) == ("ok", "dark"), "known since is what counts"


def test_a_capture_that_is_being_prepared_does_not_begin_after_a_blackout(
    rig_file, world, tmp_path, monkeypatch
):
    with serving(rig_file, tmp_path) as http:
        with stuck(monkeypatch, CaptureWriter, "create") as waiting:
            responses = []
            start_capture = threading.Thread(
                target=lambda: responses.append(http.post("/captures", json=LONG))
            )
            start_capture.start()
            until(waiting)
            assert_it_can_be_darkened(http, world, None)
        start_capture.join()
        (response,) = responses
        assert response.json()["type"] == "/docs/errors.md#not-now"
        assert world.pulses == 0
        (listed,) = http.get("/captures").json()
        assert (listed["outcome"], listed["frames_written"]) == ("interrupted", 0)


def test_a_fault_gets_a_response_and_keeps_the_connection(rig_file, world, tmp_path, monkeypatch):
    # pytest's workers can't hand on a log with half a character
    monkeypatch.setattr(logging.root.manager, "disable", logging.CRITICAL)
    with serving(rig_file, tmp_path) as http:

        def broken(*_: Any) -> None:
            raise RuntimeError("caf\udce9")

        monkeypatch.setattr(http.service, "captures", broken)
        port = http.base_url.port
        with socket.create_connection(("127.0.0.1", port)) as line:
            responses = line.makefile("rb")
            for path, status in (("/captures", b"500"), ("/health", b"200")):
                line.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
                head, length = responses.readline(), 0
                assert status in head, (path, head)
                while (field := responses.readline()) != b"\r\n":
                    if field.lower().startswith(b"content-length:"):
                        length = int(field.split(b":")[1])
                body = json.loads(responses.read(length))
                if status == b"500":
                    assert body["detail"] == r"RuntimeError: caf\udce9"


def test_it_darkens_first_and_starts_whatever_lies_in_its_folder(
    rig_file, world, tmp_path, monkeypatch
):
    for name, text in {
        "captures/poisoned/plan.json": r'{"steps": [], "request": {"environment": "\ud800"}}',
        "captures/poisoned/rig.json": "{}",
        "captures/deep/plan.json": "[" * 10**5,
        "jobs.sqlite": "no database " * 1000,
        "unsafe.json": "[1]",
        "audit.jsonl": '{"time": "\ud800',
        "models/m/progress.json": "",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(text.encode("utf-8", "surrogatepass"))
    lit_at_the_first_look = []
    real = status_index.read_status

    def look(path: Path) -> Any:
        lit_at_the_first_look.append((set(world.lit), world.show))
        return real(path)

    monkeypatch.setattr(status_index, "read_status", look)
    world.lit, world.show = {1, 2}, "ON 65535"
    with serving(rig_file, tmp_path) as http:
        assert lit_at_the_first_look == [(set(), "OFF")] * 2
        listed = http.get("/captures").json()
        assert [(c["id"], c["outcome"]) for c in listed] == [
            ("deep", "damaged"),
            ("poisoned", "damaged"),
        ]
        frame = http.get("/captures/poisoned/frames/0/cam_0.exr").json()
        assert (frame["status"], frame["type"]) == (409, "/docs/errors.md#damaged-capture")
        until(lambda: http.get("/health").json()["problems"])
        health = http.get("/health").json()
        assert health["status"] == "degraded"  # the latch was cleared by the blackout at the start
        assert "renamed to" in health["problems"][0]
        assert http.get("/jobs").json() == []
        assert http.get("/audit").status_code == 200


def test_listeners_hold_no_thread_and_receive_all_events(rig_file, tmp_path):
    with serving(rig_file, tmp_path) as http, ExitStack() as links:
        address = (http.base_url.host, http.base_url.port)
        lines = []
        for _ in range(60):
            link = links.enter_context(socket.create_connection(address))
            link.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
            lines.append(links.enter_context(link.makefile("rb")))
        for line in lines:
            assert b"200" in line.readline()
        threads = {thread.name for thread in threading.enumerate()}
        assert not any(name.startswith("asyncio_") for name in threads), threads
        for number in range(700):  # more than one piece
            http.service.events.publish("test", {"n": number})
        for line in lines:
            received = (json.loads(x[6:]) for x in line if x.startswith(b"data: "))
            numbers = (e["data"]["n"] for e in received if e["kind"] == "test")
            assert list(islice(numbers, 700)) == list(range(700))


def test_a_start_waits_for_no_capture_on_the_disk(rig_file, world, tmp_path, monkeypatch):
    """The newest are listed, what is asked for is read at once, and what waits waits for all."""
    names = [f"2026010{day}-120000-0000" for day in range(1, 5)]
    for name in names:
        step = Step(0, "dark", 0.01)
        CaptureWriter.create(tmp_path / "captures" / name, rig_file.rig, {"steps": [step]}).close()
    waits = {"plan": {"lights": ["light_000"], "projectors": [], "sentinels": False}}
    with serving(rig_file, tmp_path) as http:
        assert [c["id"] for c in http.get("/captures").json()] == names
        http.post("/queue:hold")
        assert http.post("/queue", json=waits).is_success
    (tmp_path / "captures.index").unlink()
    free, real = threading.Event(), Catalogue._read

    def slow(self: Catalogue, folder: Path) -> None:
        if folder.name == names[1] and threading.current_thread().name == "catalogue":
            free.wait()
        real(self, folder)

    monkeypatch.setattr(Catalogue, "_read", slow)
    with serving(rig_file, tmp_path, all_read=False) as http:
        try:
            assert_it_can_be_darkened(http, world, None)
            until(lambda: http.get("/health").json()["unread"] == 2)
            response = http.get("/captures")
            assert [c["id"] for c in response.json()] == names[2:]
            assert response.headers["hairstage-unread"] == "2"
            assert http.get(f"/captures/{names[0]}").json()["outcome"] == "interrupted"
            assert http.get("/health").json()["unread"] == 1
            http.go_on()
            waiting = http.get("/queue").json()
            assert (len(waiting["waiting"]), "1 to come" in waiting["waits_for"]) == (1, True)
        finally:
            free.set()
        until(lambda: [c["id"] for c in http.get("/captures").json()][:4] == names)
        until(lambda: http.get("/queue/history").json())
        read = [e for e in http.service.events.wait(0, 0) if e.kind == "captures.read"]
        assert [e.data for e in read] == [{"count": 4}]
