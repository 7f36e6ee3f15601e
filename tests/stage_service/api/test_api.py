"""The HTTP API over real sockets: captures, frames, jobs, events, and errors as problems."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
import uvicorn
from serving import serving
from waiting import until

from reconstruction import Model, read_exr
from stage_service.api.app import create_app
from stage_service.api.connections import LOOPBACK
from stage_service.api.problems import KINDS, Problem
from stage_service.config import RigFile
from stage_service.device_config import LightRegisters
from stage_service.jobs.records import Job, PipelineRequest
from stage_service.service import Service
from stage_service.service_models import CaptureRequest, CaptureView, JobRequest, RigView

SHORT = {
    "lights": ["light_003", "light_000"],
    "projectors": [],
    "exposure": {"olat": 0.01},  # the peers answer lamp number + 1 counts at this exposure
}


class Server:
    """The application on a free port, in a thread."""

    def __init__(self, rig_file: RigFile, root: Path) -> None:
        self.service = Service(rig_file, root)
        config = uvicorn.Config(
            create_app(self.service), host=LOOPBACK, port=0, log_level="error", ws="none"
        )
        self.server = uvicorn.Server(config)
        self.thread = threading.Thread(target=self.server.run)
        self.thread.start()
        until(lambda: self.server.started and not self.service.unread)
        port = self.server.servers[0].sockets[0].getsockname()[1]
        self.http = httpx.Client(base_url=f"http://{LOOPBACK}:{port}", timeout=20, trust_env=False)

    def stop(self) -> None:
        self.http.close()
        self.server.should_exit = True
        self.thread.join(20)
        assert not self.thread.is_alive()


@pytest.fixture
def server(rig_file: RigFile, tmp_path: Path) -> Iterator[Server]:
    server = Server(rig_file, tmp_path / "root")
    yield server
    server.stop()


@pytest.fixture
def http(server: Server) -> httpx.Client:
    return server.http


@pytest.fixture
def head(tmp_path: Path) -> str:
    path = tmp_path / "head.obj"
    path.write_text("v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\ng scalp\nf 1 2 3\n")
    return str(path)


def capture_done(http: httpx.Client, body: dict[str, Any]) -> dict[str, Any]:
    begun = http.post("/captures", json=body)
    assert begun.status_code == 202, begun.text
    where = begun.headers["location"]
    until(lambda: http.get(where).json()["state"] == "done")
    done: dict[str, Any] = http.get(where).json()
    return done


def problem(response: httpx.Response, slug: str) -> dict[str, Any]:
    """Check that the response is a problem document of this kind, and return it."""
    assert response.headers["content-type"] == "application/problem+json", response.text
    data: dict[str, Any] = response.json()
    assert data["type"] == f"/docs/errors.md#{slug}"
    assert data["status"] == response.status_code
    assert data["title"] == KINDS[slug].title
    assert data["detail"]
    return data


def test_a_plan_is_costed_without_touching_the_stage(http, world):
    cost = http.post("/plans:validate", json=SHORT).json()
    assert (cost["steps"], cost["frames"]) == (6, 18)
    assert cost["bytes"] > 18 * 8 * 6 * 12
    assert cost["seconds"] > 0
    assert world.pulses == 0
    refused = http.post("/plans:validate", json={"lights": ["light_999"]})
    assert "light_999" in problem(refused, "invalid-plan")["problems"][0]
    refused = http.post("/plans:validate", json={"exposures": {}})
    errors = problem(refused, "invalid-request")["errors"]
    assert errors == [{"loc": "exposures", "msg": "Extra inputs are not permitted"}]


def test_a_capture_its_frames_and_its_job(http, server, head):
    pipeline = {"name": "light_planes", "options": {"seed": 3}}
    done = capture_done(http, {"plan": SHORT, "pipeline": pipeline, "head": head})
    assert (done["outcome"], done["frames_written"], done["frames_missing"]) == ("completed", 18, 0)
    assert [c["id"] for c in http.get("/captures").json()] == [done["id"]]

    frames = f"/captures/{done['id']}/frames"
    exr = server.service.root / "frame.exr"
    exr.write_bytes(http.get(f"{frames}/2/cam_0.exr").content)
    image, attributes = read_exr(exr)
    assert image.shape == (6, 8, 3)
    assert image.mean() == pytest.approx(4 * attributes["countScale"], rel=1e-4)
    png = http.get(f"{frames}/2/cam_0.png")
    assert png.headers["content-type"] == "image/png"
    picture = cv2.imdecode(np.frombuffer(png.content, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (6, 8, 3)
    assert (picture == 255).all()  # an even picture is exposed to white
    assert "cam_2" in problem(http.get(f"{frames}/2/cam_9.exr"), "unknown-frame")["detail"]
    problem(http.get(f"{frames}/99/cam_0.png"), "unknown-frame")
    problem(http.get("/captures/nope/frames/0/cam_0.exr"), "unknown-capture")

    job = http.get(f"/jobs/{done['job']}").json()
    assert (job["state"], job["pipeline"], job["capture"]) == (
        "queued",
        "light_planes",
        done["path"],
    )
    assert job["options"]["seed"] == 3
    assert [j["id"] for j in http.get("/jobs").json()] == [job["id"]]
    cancelled = http.delete(f"/jobs/{job['id']}").json()
    assert (cancelled["state"], cancelled["outcome"]) == ("done", "cancelled")

    submitted = http.post(
        "/jobs", json={"capture": done["id"], "pipeline": {"name": "reconstruct"}}
    )
    assert submitted.status_code == 202
    assert http.get(submitted.headers["location"]).json()["capture"] == done["path"]
    refused = {"name": "fit", "options": {"held_out_cameras": ["cam_7"]}}
    refused = http.post("/jobs", json={"capture": done["id"], "pipeline": refused})
    assert "cam_7" in problem(refused, "bad-input")["detail"]


def test_a_job_that_is_about_to_be_enqueued_can_be_cancelled(http, server, head, monkeypatch):
    monkeypatch.setattr(server.service._follower, "_enqueue_pending", lambda: None)
    body = {"plan": SHORT, "pipeline": {"name": "reconstruct"}, "head": head}
    job = capture_done(http, body)["job"]
    cancelled = http.delete(f"/jobs/{job}")
    assert cancelled.status_code == 200, cancelled.text
    assert (cancelled.json()["id"], cancelled.json()["outcome"]) == (job, "cancelled")
    assert [j["outcome"] for j in http.get("/jobs").json()] == ["cancelled"]


def test_a_job_whose_enqueuing_was_lost_is_enqueued_at_the_next_start(rig_file, tmp_path, head):
    server = Server(rig_file, tmp_path)
    server.service._captures._on_complete = None  # as if killed right after the manifest
    body = {"plan": SHORT, "pipeline": {"name": "reconstruct"}, "head": head}
    begun = server.http.post("/captures", json=body).json()
    until(lambda: server.service._captures.get(begun["id"]).state == "done")
    assert server.http.get("/jobs").json() == []
    server.stop()
    server = Server(rig_file, tmp_path)
    try:
        until(lambda: server.http.get("/jobs").json())
        assert [j["pipeline"] for j in server.http.get("/jobs").json()] == ["reconstruct"]
        assert server.http.get(f"/captures/{begun['id']}").json()["job"] is not None
    finally:
        server.stop()


def test_steering_a_capture(http, world):
    with world.held():
        capture = http.post("/captures", json={"plan": {"projectors": []}}).json()["id"]
        paused = http.post(f"/captures/{capture}/pause")
    assert paused.status_code == 200
    until(lambda: http.get(f"/captures/{capture}").json()["state"] == "paused")
    assert not world.lit
    busy = problem(http.post("/captures", json={"plan": SHORT}), "busy")
    assert busy["running"] == capture
    assert http.get("/health").json()["capture"] == capture
    http.post(f"/captures/{capture}/resume")
    until(lambda: http.get(f"/captures/{capture}").json()["state"] == "running")
    assert http.post(f"/captures/{capture}/abort").status_code == 200
    until(lambda: http.get(f"/captures/{capture}").json()["state"] == "done")
    assert http.get(f"/captures/{capture}").json()["outcome"] == "aborted"
    assert not world.lit
    assert problem(http.post(f"/captures/{capture}/pause"), "wrong-state")["state"] == "done"
    submit = http.post("/jobs", json={"capture": "nope", "pipeline": {"name": "fit"}})
    problem(submit, "unknown-capture")


def snapshot(http: httpx.Client) -> dict[str, Any]:
    taken: dict[str, Any] = http.get("/captures/snapshot").json()
    return taken


def test_without_devices_the_service_says_that_there_is_no_stage(rig_file, tmp_path):
    with serving(replace(rig_file, devices=None), tmp_path / "root") as http:
        for path in ("/captures", "/snapshot", "/queue"):
            reported = problem(http.post(path, json={}), "no-stage")
            assert reported["status"] == 409
            assert "[devices] is missing" in reported["detail"]
        problem(http.post("/devices/blackout"), "no-stage")
        problem(http.get("/ready"), "not-ready")
        assert http.get("/health").json()["lamps_detail"] == "the rig file names no devices"
        assert http.get("/queue").json()["waiting"] == http.get("/captures").json() == []


def test_a_snapshot_shows_one_light_and_is_no_capture(http, world):
    begun = http.post("/snapshot", json={"light": "light_003", "exposure": 0.02})
    assert (begun.status_code, begun.json()["id"]) == (202, "snapshot")
    ended = partial(until, lambda: s if (s := snapshot(http))["state"] == "done" else None)
    first = ended()
    assert (first["outcome"], first["frames_written"], world.pulses) == ("completed", 3, 1)
    (step,) = http.get("/captures/snapshot/steps").json()
    assert (step["light"], step["exposure"], step["lacks"]) == ("light_003", 0.02, [])
    counts = http.get("/captures/snapshot/frames/0/cam_0.json").json()["largest"]
    assert counts * 1e4 * 0.02 == pytest.approx(2 * 4)  # the cameras' gain; see `SHORT`
    assert not world.lit

    problem(http.post("/snapshot", json={"light": "light_999"}), "invalid-plan")
    job = {"capture": "snapshot", "pipeline": {"name": "fit"}}
    problem(http.post("/jobs", json=job), "bad-input")
    http.post("/snapshot", json={})
    second = ended()
    assert second["started"] > first["started"]
    assert http.get("/captures/snapshot/steps").json()[0]["kind"] == "all_on"
    assert http.get("/captures").json() == []
    world.stuck_lamps, world.lit = True, {3}
    assert http.post("/devices/blackout").json()["safe"] is False
    problem(http.post("/snapshot", json={}), "unsafe")
    assert sum(r.startswith("PULSE") for r in world.requests) == 2


def test_artifacts_stay_inside_the_model_folder(http, server, tmp_path):
    model = server.service.root / "models" / "m"
    (model / "masks").mkdir(parents=True)
    (model / "report.json").write_text('{"stages": []}')
    (model / "masks" / "cam_0.png").write_bytes(b"png")
    (tmp_path / "secret").write_text("secret")
    (model / "way_out").symlink_to(tmp_path / "secret")
    queue = server.service._queue
    queue.submit(PipelineRequest(name="fit"), tmp_path, Model(model), job="job-1")
    listed = {a["path"]: a["bytes"] for a in http.get("/jobs/job-1/artifacts").json()}
    assert listed == {"masks/cam_0.png": 3, "report.json": 14}
    assert http.get("/jobs/job-1/artifacts/masks/cam_0.png").content == b"png"
    assert http.get("/jobs/job-1/report").json() == {"stages": []}
    for path in ("nope", "masks", "..%2f..%2f..%2fsecret", "way_out", "%2e%2e/%2e%2e/jobs.sqlite"):
        problem(http.get(f"/jobs/job-1/artifacts/{path}"), "unknown-artifact")
    problem(http.get("/jobs/job-2/report"), "unknown-job")


def test_frames_are_those_of_the_capture(http, tmp_path):
    """A capture folder that was put there, whose journal names another file of this machine."""
    done = capture_done(http, {"plan": SHORT})
    folder = Path(done["path"])
    (tmp_path / "secret").write_text("secret")
    journal = folder / "journal.jsonl"
    journal.write_text(journal.read_text().replace("frames/00000/cam_0.exr", "../../../secret"))
    problem(http.get(f"/captures/{done['id']}/frames/0/cam_0.exr"), "damaged-capture")
    assert http.get(f"/captures/{done['id']}/frames/0/cam_1.exr").status_code == 200


def test_frames_of_a_capture_have_figures_and_previews(http, rig_file):
    done = capture_done(http, {"plan": SHORT})
    frames = f"/captures/{done['id']}/frames"
    steps = http.get(f"/captures/{done['id']}/steps").json()
    assert [s["light"] for s in steps if s["kind"] == "olat"] == SHORT["lights"]
    assert all(s["lacks"] == [] for s in steps)
    (step,) = [s["index"] for s in steps if s["light"] == "light_003"]
    figures = http.get(f"{frames}/{step}/cam_0.json").json()
    exact, _ = read_exr(Path(done["path"]) / f"frames/{step:05d}/cam_0.exr")
    assert figures["largest"] == pytest.approx(float(exact.max()))
    assert (figures["width"], figures["height"]) == (exact.shape[1], exact.shape[0]) == (8, 6)
    assert sum(figures["histogram"]) == exact.size
    assert figures["saturated"] == 0
    white = {"white": 2 * figures["largest"], "size": 8}
    png = np.frombuffer(http.get(f"{frames}/{step}/cam_0.png", params=white).content, np.uint8)
    brightest = cv2.imdecode(png, cv2.IMREAD_COLOR).max()
    assert brightest == round(255 * (1.055 * 0.5 ** (1 / 2.4) - 0.055)), "half of white, in sRGB"
    for beyond in ("1e-320", "1e308", "inf", "0"):  # no number of a frame's, or none at all
        refused = http.get(f"{frames}/{step}/cam_0.png", params={"white": beyond})
        problem(refused, "invalid-request")
    rig = http.get("/rig").json()
    assert [x["name"] for x in rig["lights"]] == [x.name for x in rig_file.rig.lights]
    camera = rig_file.rig.cameras[0]
    ahead = camera.rays([[(camera.width - 1) / 2, (camera.height - 1) / 2]])[0]
    assert rig["cameras"][0]["towards"] == pytest.approx(ahead.tolist(), abs=1e-6)
    assert rig_file.devices is not None
    assert rig["watchdog_s"] == rig_file.devices.watchdog_s


def test_a_bank_without_a_watchdog_has_no_seconds(rig_file):
    assert rig_file.devices is not None
    lights = rig_file.devices.lights.model_copy(update={"registers": LightRegisters(watchdog=None)})
    devices = rig_file.devices.model_copy(update={"lights": lights})
    assert RigView.of(replace(rig_file, devices=devices)).watchdog_s is None


def test_a_stream_without_events_shows_that_the_service_lives(http):
    with http.stream("GET", "/events") as response:
        comments = (line for line in response.iter_lines() if line)
        assert [next(comments), next(comments)] == [": pulse", ": pulse"]


def read_events(http: httpx.Client, count: int, headers: dict[str, str]) -> list[dict[str, Any]]:
    """The first `count` events of the stream, each checked against its frame."""
    events: list[dict[str, Any]] = []
    frame: dict[str, str] = {}
    with http.stream("GET", "/events", headers=headers) as response:
        assert response.headers["content-type"].startswith("text/event-stream")
        for line in response.iter_lines():
            key, _, value = line.partition(": ")
            if key in ("id", "event", "data"):
                frame[key] = value
            elif not line and frame:
                event = json.loads(frame["data"])
                assert (str(event["number"]), event["kind"]) == (frame["id"], frame["event"])
                events.append(event)
                frame = {}
                if len(events) == count:
                    break
    return events


def test_events_are_numbered_and_replay_from_the_last_event_id(http, server):
    done = capture_done(http, {"plan": SHORT})
    newest = server.service.events.last
    first = read_events(http, newest, {"Last-Event-ID": "0"})
    assert [e["number"] for e in first] == list(range(1, newest + 1))
    states = [e["data"]["state"] for e in first if e["kind"] == "capture.state"]
    assert (states[0], states[-1]) == ("running", "done")
    assert all(e["data"]["id"] == done["id"] for e in first if e["kind"].startswith("capture."))
    assert read_events(http, 2, {"Last-Event-ID": "3"}) == first[3:5]
    # A number from before a restart is not waited for: everything is replayed.
    assert read_events(http, 1, {"Last-Event-ID": "100000"}) == first[:1]
    problem(http.get("/events", headers={"Last-Event-ID": "-1"}), "invalid-request")


@pytest.mark.parametrize("text", ["", '{"job": "job-8"', "[]"])
def test_progress_that_a_power_cut_left_ends_nothing(http, server, tmp_path, text):
    """Neither the list of jobs nor the thread that tells of them."""
    before, model = server.service.events.last, Model(tmp_path / "m").create()
    model.file("progress.json").write_text(text)
    for job, place in (("job-8", model), ("job-9", Model(tmp_path / "n"))):
        server.service._queue.submit(PipelineRequest(name="fit"), tmp_path, place, job=job)
        (event,) = read_events(http, 1, {"Last-Event-ID": str(before)})
        assert (event["kind"], event["data"]["job"]) == ("job.state", job)
        before = event["number"]
    listed = {job["id"]: job["progress"] for job in http.get("/jobs").json()}
    assert listed == {"job-8": None, "job-9": None}


def test_files_of_a_request_are_checked_before_anything_is_lit(http, world, tmp_path):
    (tmp_path / "head.obj").write_text("v 0 0 0\n")
    for body, named in (
        ({"head": str(tmp_path / "none.obj")}, "none.obj"),
        ({"head": str(tmp_path / "head.obj")}, "no faces"),
        ({"masks": str(tmp_path)}, "cam"),
    ):
        refused = http.post("/captures", json={"plan": SHORT, **body})
        assert named in problem(refused, "bad-input")["detail"]
    cv2.imwrite(str(tmp_path / "cam_0.png"), np.zeros((4, 4), np.uint8))
    refused = http.post("/captures", json={"plan": SHORT, "masks": str(tmp_path)})
    assert "a PNG of 8x6 pixels, got 4x4" in problem(refused, "bad-input")["detail"]
    assert http.get("/captures").json() == []
    assert world.pulses == 0


def test_a_pipeline_that_cannot_run_is_refused_before_the_capture(http, world, head):
    for pipeline, given, why in (
        ("light_planes", {}, "give the head"),
        ("fit", {"head": head}, "needs existing strands"),
    ):
        refused = http.post("/captures", json={"pipeline": {"name": pipeline}, **given})
        assert why in problem(refused, "bad-input")["detail"]
    headless = {"name": "reconstruct", "options": {"method": "auto"}}
    assert capture_done(http, {"plan": SHORT, "pipeline": headless})["job"]
    done = capture_done(http, {"plan": SHORT})
    for options, why in (
        ({"truth": "/nowhere/truth.npz"}, "options.truth: [Errno 2]"),
        ({"environment": "dawn"}, "options.environment: [Errno 2]"),
        ({"reconstruct": {"head_mesh": "/dev/zero"}}, "head_mesh: /dev/zero is no plain file"),
    ):
        pipeline = {"name": "light_planes", "options": options}
        refused = http.post("/jobs", json={"capture": done["id"], "pipeline": pipeline})
        assert why in problem(refused, "bad-input")["detail"]
    refused = http.post("/jobs", json={"capture": done["id"], "pipeline": {"name": "fit"}})
    assert "a model with strands" in problem(refused, "bad-input")["detail"]


@pytest.mark.parametrize(
    ("options", "place"),
    [
        ({"heldout": []}, "heldout"),
        ({"seed": -1}, "seed"),
        ({"seed": 2**32}, "seed"),
        ({"reconstruct": {"seed": 3}}, "reconstruct"),
        ({"reconstruct": {"roots": 10**15}}, "reconstruct.roots"),
        ({"reconstruct": {"measure": {"thinn": 1}}}, "reconstruct.measure.thinn"),
        (
            {"reconstruct": {"measure": {"bank": {"wavelength": 1.0}}}},
            "reconstruct.measure.bank.wavelength",
        ),
        ({"fit": {"hair_pixel": 3}}, "fit.hair_pixel"),
        ({"inverse_rendering": {"fit": {"stepps": 3}}}, "inverse_rendering.fit.stepps"),
        (
            {"inverse_rendering": {"fit": {"effort": {"spp": 0}}}},
            "inverse_rendering.fit.effort.spp",
        ),
        ({"assess": {"cameras": 0}}, "assess.cameras"),
    ],
)
def test_an_option_that_is_unknown_or_bad_is_refused_with_its_place(http, world, options, place):
    pipeline = {"name": "light_planes", "options": options}
    for path, body in (("/jobs", {"capture": "any"}), ("/captures", {"plan": SHORT})):
        refused = problem(http.post(path, json={**body, "pipeline": pipeline}), "invalid-request")
        (error,) = refused["errors"]
        assert error["loc"] == f"pipeline.options.{place}"
        assert f"{error['loc']}: {error['msg']}" == refused["detail"]
    assert http.get("/jobs").json() == []
    assert world.pulses == 0


def test_every_route_is_documented(http):
    document = http.get("/openapi.json").json()
    for item in document["paths"].values():
        for operation in item.values():
            assert operation["summary"]
            assert operation["description"]
            assert "application/problem+json" in operation["responses"]["default"]["content"]
    schemas = document["components"]["schemas"]
    for model in (CaptureRequest, CaptureView, JobRequest, Job, Problem):
        for example in model.model_json_schema()["examples"]:
            model.model_validate(example)
        assert model is Problem or schemas[model.__name__]["examples"]
    assert "hair_pixels" in schemas["FitOptions"]["properties"]
    assert schemas["Effort"]["properties"]["spp"]["exclusiveMinimum"] == 0
    problem(http.get("/nowhere"), "http")
    problem(http.put("/jobs"), "http")


@pytest.mark.parametrize(
    ("body", "why"),
    [
        (r'{"plan": {"consent": "\ud800 agreed, 3 May"}}', "not Unicode"),
        (r'{"head": "/data/he\u0000ad.obj"}', "NUL"),
        ('{"plan": {"rate_hz": NaN}}', "NaN"),
        ('{"plan": {"rate_hz": 1e999}}', "1e999"),
        ('{"plan": {}, "plan": {}}', "twice"),
        ('{"plan": ' + "[" * 50 + "]" * 50 + "}", "levels"),
        ("[" * 100_000, "levels"),
        ('{"plan": ', "Expecting value"),
        (b'{"plan": "\xff"}', "utf-8"),
        ('{"plan": {"rate_hz": 5e-324}}', "greater than or equal to 0.01"),
        ('{"plan": {"retries": -1}}', "greater than or equal to 0"),
        ('{"plan": {"rows": {"step": 1' + "0" * 400 + "}}}", "rows"),
    ],
)
def test_invalid_json_is_refused_before_a_lamp_is_lit(http, world, body, why):
    refused = http.post("/captures", content=body, headers={"content-type": "application/json"})
    (error,) = problem(refused, "invalid-request")["errors"]
    assert why in error["msg"] or why in error["loc"]
    assert http.get("/captures").json() == []
    assert world.pulses == 0


def test_paths_that_no_file_can_have_are_refused(http, world, tmp_path):
    for path in ("/" + "n" * 300, "/".join("n" * 3000), str(tmp_path), "/dev/zero", "/dev/stdin"):
        for field in ("head", "masks"):
            refused = http.post("/captures", json={"plan": SHORT, field: path})
            problem(refused, "bad-input")
    for name in ("%00", "n" * 300, "..%2f..", "%ff", "caf%ed%a0%80"):
        for path in (f"/captures/{name}", f"/captures/{name}/frames/0/cam_0.png"):
            problem(http.get(path), "unknown-capture" if "%2f" not in name else "http")
        problem(http.get(f"/jobs/{name}"), "unknown-job" if "%2f" not in name else "http")
    assert world.pulses == 0


def test_a_frame_that_is_gone_or_cut_is_damage_not_a_fault(http, server):
    done = capture_done(http, {"plan": SHORT})
    folder, frames = Path(done["path"]), f"/captures/{done['id']}/frames"
    cut, gone = (next(folder.glob(f"frames/*{i}/cam_0.exr")) for i in (1, 2))
    cut.write_bytes(cut.read_bytes()[:500])
    gone.unlink()
    problem(http.get(f"{frames}/1/cam_0.png"), "damaged-capture")
    for suffix in ("png", "exr"):
        assert (
            "cam_0.exr"
            in problem(http.get(f"{frames}/2/cam_0.{suffix}"), "damaged-capture")["detail"]
        )
    assert http.get(f"{frames}/3/cam_0.png").status_code == 200
    journal = folder / "journal.jsonl"
    lines = journal.read_text().splitlines()
    journal.write_text("\n".join([lines[0], lines[1][:40], *lines[2:]]) + "\n")
    assert "line 2" in problem(http.get(f"{frames}/3/cam_0.png"), "damaged-capture")["detail"]
    job_request = {"capture": done["id"], "pipeline": {"name": "reconstruct"}}
    problem(http.post("/jobs", json=job_request), "damaged-capture")


def test_jobs_need_a_capture_that_completed_and_a_model_of_their_own(http, world, server, head):
    with world.held():
        aborted = http.post("/captures", json={"plan": {"projectors": []}}).json()["id"]
        http.post(f"/captures/{aborted}/abort")
    until(lambda: http.get(f"/captures/{aborted}").json()["state"] == "done")
    job_request = {"capture": aborted, "pipeline": {"name": "reconstruct"}}
    assert "aborted" in problem(http.post("/jobs", json=job_request), "not-finished")["detail"]
    whole = capture_done(http, {"plan": SHORT})["id"]
    job_request = {"capture": whole, "pipeline": {"name": "reconstruct"}, "model": "shared"}
    first = http.post("/jobs", json=job_request)
    assert first.status_code == 202
    again = problem(http.post("/jobs", json=job_request), "model-in-use")
    assert first.json()["id"] in again["detail"]
    assert http.post("/jobs", json={**job_request, "model": "own"}).status_code == 202
    http.delete(f"/jobs/{first.json()['id']}")
    assert http.post("/jobs", json=job_request).status_code == 202
    pages = [http.get("/jobs", params={"limit": 2, "offset": o}).json() for o in (0, 2)]
    assert [len(p) for p in pages] == [2, 1]
