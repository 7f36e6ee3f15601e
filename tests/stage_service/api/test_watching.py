"""What monitoring sees of a service: its figures, whether it is ready, its log."""

from __future__ import annotations

import json
import logging
import shutil
import threading
from collections import namedtuple

from prometheus_client.parser import text_string_to_metric_families
from serving import Client, serving
from waiting import until

from stage_service import watching
from stage_service.cli.stage.processes import log_to_stderr
from stage_service.jobs.slots import WorkerSlot
from stage_service.records.logs import about

SHORT = {"plan": {"lights": ["light_003", "light_000"], "projectors": []}}


def figures(http: Client) -> dict[tuple[str, ...], float]:
    """What `/metrics` says, as Prometheus's own reader reads it: (name, label values…) → value."""
    response = http.get("/metrics")
    assert response.status_code == 200, response.text
    assert response.headers["content-type"].startswith("text/plain; version=0.0.4")
    return {
        (sample.name.removeprefix("hairstage_"), *sample.labels.values()): sample.value
        for family in text_string_to_metric_families(response.text)
        for sample in family.samples
    }


def shot(http: Client) -> dict:
    capture = http.post("/captures", json=SHORT).json()["id"]
    return until(
        lambda: c if (c := http.get(f"/captures/{capture}").json())["state"] == "done" else None
    )


def test_frames_captures_and_faults_are_counted(rig_file, world, tmp_path):
    with serving(rig_file, tmp_path) as http:
        before = figures(http)
        assert before["capture", "idle"] == before["lamps", "dark"] == 1
        assert before[("latched",)] == 0
        assert before["frames_total", "written"] == before["captures_total", "failed"] == 0
        world.drop = {("cam_1", 2)}  # the second pulse: shot again
        done = shot(http)
        after = figures(http)
        assert after["frames_total", "written"] == done["frames_written"] == 18
        assert after["frames_total", "again"] == 1
        assert after["frames_total", "missing"] == 0
        assert after["captures_total", "completed"] == 1
        world.mute = {"cam_2"}
        assert shot(http)["outcome"] == "failed"
        world.mute = set()
        after = figures(http)
        assert after["captures_total", "failed"] == 1
        (fault,) = [k for k in after if k[0] == "device_faults_total"]
        assert "cam_2" in fault[1]
        assert after[fault] == 1
        devices = http.get("/devices").json()
        assert devices["lights"]["state"] == "ok"
        counts = {name: d["since_start"] for name, d in devices["cameras"].items()}
        assert counts["cam_0"] == {"frames": 6, "missed": 0, "late": 0, "timeouts": 0, "faults": 0}
        assert counts["cam_1"] == {"frames": 6, "missed": 1, "late": 0, "timeouts": 0, "faults": 0}
        assert counts["cam_2"] == {"frames": 6, "missed": 0, "late": 0, "timeouts": 1, "faults": 0}
        assert devices["lights"]["since_start"] == {"timeouts": 0, "faults": 0}
        assert figures(http)["device_reachable", "lights"] == 1


def test_a_missing_frame_is_counted_once_over_repeated_resumes(rig_file, world, tmp_path):
    with serving(rig_file, tmp_path) as http:
        world.drop = {("cam_1", 3)}
        plan = {"projectors": [], "retries": 0}
        capture = http.post("/captures", json={"plan": plan}).json()["id"]
        until(lambda: world.pulses > 4)
        http.post(f"/captures/{capture}/abort")
        until(lambda: http.get(f"/captures/{capture}").json()["state"] == "done")
        assert figures(http)["frames_total", "missing"] == 1
        world.busy = {"cam_1": 10**9}  # it goes on with that frame, and waits for it
        http.post(f"/captures/{capture}/resume").raise_for_status()
        assert figures(http)["frames_total", "missing"] == 1
        http.post("/devices/blackout")


def test_workers_disk_and_jobs_are_those_of_the_last_query(rig_file, tmp_path, monkeypatch):
    slot = WorkerSlot(tmp_path)
    usage = namedtuple("usage", "total used free")(10**12, 0, 5 * 10**11)
    with serving(rig_file, tmp_path) as http:
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
        until(lambda: ("jobs", "queued") in figures(http), pause=0.1)
        observed = figures(http)
        assert observed["jobs", "queued"] == observed["jobs", "running"] == 0
        assert observed[("job_database_up",)] == 1
        assert observed[("disk_free_bytes",)] == 5e11
        name = f"{slot.host}/{slot.name}"
        assert observed["worker_alive", name] == 1
        assert 0 <= observed["worker_heartbeat_age_seconds", name] < 60
        slot.release()
        assert figures(http)["worker_alive", name] == 0
        assert http.get("/ready").json() == {"ready": True}

        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=10**7))
        response = http.get("/ready").json()
        assert (response["status"], response["type"]) == (503, "/docs/errors.md#not-ready")
        assert "10 MB free" in response["problems"][0]

        monkeypatch.setattr(watching, "SILENT_S", 0.0)
        free = threading.Event()
        monkeypatch.setattr(shutil, "disk_usage", lambda _: free.wait() and usage)
        assert figures(http)[("disk_free_bytes",)] == 1e7  # it hangs: as it was last seen
        assert "does not respond" in http.get("/ready").json()["problems"][0]
        free.set()


def test_a_missing_disk_is_reported_and_no_folder_replaces_it(rig_file, world, tmp_path):
    with serving(rig_file, tmp_path) as http:
        (tmp_path / "captures").rename(tmp_path / "unmounted")
        assert "check its disk" in http.get("/ready").json()["problems"][0]
        refused = http.post("/captures", json={"plan": {}}).json()
        assert (refused["status"], refused["type"]) == (422, "/docs/errors.md#invalid-plan")
        assert "captures does not exist" in refused["detail"]
        assert http.post("/devices/blackout").json()["state"] == "dark"
        assert not (tmp_path / "captures").exists()
        (tmp_path / "unmounted").rename(tmp_path / "captures")
        assert http.get("/ready").json() == {"ready": True}


def test_neither_queries_the_job_database(rig_file, tmp_path, monkeypatch):
    monkeypatch.setenv("HAIRSTAGE_DATABASE_URL", "postgresql://nobody@127.0.0.1:1/nothing")
    with serving(rig_file, tmp_path) as http:
        until(lambda: figures(http)[("job_database_up",)] == 0, pause=0.1)
        assert http.get("/ready").status_code == 200


def test_the_service_is_not_ready_while_darkness_is_unknown(rig_file, world, tmp_path):
    with serving(rig_file, tmp_path) as http:
        world.deaf_lights = True
        assert http.post("/devices/blackout").json()["state"] == "unknown, unsafe"
        assert figures(http)[("latched",)] == figures(http)["lamps", "unknown, unsafe"] == 1
        assert "light bank" in http.get("/ready").json()["problems"][0]
        world.deaf_lights = False
        http.post("/devices/blackout")
        assert http.get("/ready").status_code == 200


def test_a_bank_that_is_accepted_without_read_back_is_no_fault(unread_rig, world, tmp_path):
    with serving(unread_rig, tmp_path) as http:
        for _ in range(2):  # after the start, and after a blackout
            health = http.get("/health").json()
            assert (health["status"], health["lamps"]) == ("ok", "unknown, unsafe")
            assert http.get("/ready").status_code == 200
            assert http.post("/devices/blackout").json()["state"] == "unknown, unsafe"
        world.deaf_lights = True
        http.post("/devices/blackout")
        assert http.get("/health").json()["status"] == "unsafe"
        assert http.get("/ready").status_code == 503


def test_the_log_as_json_has_what_it_is_about(capsys, monkeypatch):
    root = logging.getLogger()
    monkeypatch.setattr(root, "handlers", [])
    monkeypatch.setattr(root, "level", root.level)
    log_to_stderr(as_json=True)
    log = logging.getLogger("hairstage.test")
    with about(capture="c1"), about(job="j1"):
        try:
            raise ValueError('a "line"\nbreak')
        except ValueError:
            log.exception("caf%s", "\udce9")
    log.info("after")
    first, second = (json.loads(line) for line in capsys.readouterr().err.splitlines())
    assert (first["capture"], first["job"], first["level"]) == ("c1", "j1", "ERROR")
    assert first["message"] == "caf\udce9"
    assert first["error"].endswith('ValueError: a "line"\nbreak')
    assert "capture" not in second
