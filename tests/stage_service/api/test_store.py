"""What lies on the service's disk: fetched, removed and restored, uploaded."""

from __future__ import annotations

import fcntl
import io
import json
import shutil
import socket
import tarfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from serving import Client, serving, slug
from waiting import until

from reconstruction import Capture, Model, verify
from stage_service import storage
from stage_service.acquisition.states import CaptureStatus
from stage_service.api import bodies
from stage_service.api.gate import Access
from stage_service.cli import main
from stage_service.jobs.queue import NoSuchJob
from stage_service.records.tokens import Tokens

SHORT = {"lights": ["light_003"], "projectors": []}
HEAD = b"v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\ng scalp\nf 1 2 3\n"


def shot(http: Client, **more: Any) -> dict[str, Any]:
    capture = http.post("/captures", json={"plan": SHORT, **more}).json()
    http.service._captures.wait(capture["id"], 30)
    status: dict[str, Any] = http.get(f"/captures/{capture['id']}").json()
    return status


def test_a_folder_comes_as_a_tar_whose_ranges_are_parts_of_the_whole(http, tmp_path):
    capture = shot(http)
    path = f"/captures/{capture['id']}/archive.tar"
    whole = http.get(path)
    assert whole.headers["accept-ranges"] == "bytes"
    with tarfile.open(fileobj=io.BytesIO(whole.content)) as tar:
        tar.extractall(tmp_path / "out", filter="data")
    copy = tmp_path / "out" / capture["id"]
    assert verify(copy) == []
    names = [p.relative_to(copy) for p in copy.rglob("*")]
    assert sorted(names) == sorted(
        p.relative_to(capture["path"]) for p in Path(capture["path"]).rglob("*")
    )
    tag, size = whole.headers["etag"], len(whole.content)
    for first, last in ((0, 0), (500, 1600), (size - 3, size + 9), (4095, 4097)):
        part = http.get(path, headers={"Range": f"bytes={first}-{last}", "If-Range": tag})
        assert part.status_code == 206
        assert part.content == whole.content[first : last + 1]
        assert part.headers["content-range"] == f"bytes {first}-{min(last, size - 1)}/{size}"
    assert http.get(path, headers={"Range": "bytes=-700"}).content == whole.content[-700:]
    beyond = http.get(path, headers={"Range": f"bytes={size}-"})
    assert (beyond.status_code, beyond.headers["content-range"]) == (416, f"bytes */{size}")
    assert http.get(path, headers={"Range": "bytes=0-1", "If-Range": '"old"'}).status_code == 200
    assert http.get(path, headers={"Range": "lines=1"}).status_code == 200
    same = http.get(path, headers={"If-None-Match": tag})
    assert (same.status_code, same.content) == (304, b"")


def test_files_have_tags_and_ranges_and_head_is_get_without_its_body(http):
    capture = shot(http)
    frame = f"/captures/{capture['id']}/frames/2/cam_0.exr"
    whole = http.get(frame)
    part = http.get(frame, headers={"Range": "bytes=10-19"})
    assert (part.status_code, part.content) == (206, whole.content[10:20])
    for path in (frame, "/health", f"/captures/{capture['id']}/archive.tar", "/nowhere"):
        got, requested = http.get(path), http.head(path)
        assert (requested.status_code, requested.content) == (got.status_code, b"")
        for name in ("content-length", "content-type", "etag"):
            assert requested.headers.get(name) == got.headers.get(name)
    begin = time.monotonic()
    assert http.head("/events", timeout=10).status_code == 200
    assert time.monotonic() - begin < 10, "an endless stream would run into the time-out"


def test_a_removed_capture_is_in_the_trash_and_can_be_restored(http):
    capture = shot(http)
    name, path = capture["id"], Path(capture["path"])
    before = {p.name: p.stat().st_size for p in path.rglob("*") if p.is_file()}
    dry = http.delete(f"/captures/{name}", params={"dry_run": True}).json()
    assert (dry["name"], dry["bytes"]) == (None, sum(p.stat().st_size for p in _files(path)))
    assert path.is_dir()
    assert http.get("/trash").json() == []
    removed = http.delete(f"/captures/{name}").json()
    assert http.get("/captures").json() == []
    assert slug(http.get(f"/captures/{name}")) == "unknown-capture"
    assert slug(http.delete(f"/captures/{name}")) == "unknown-capture"
    assert http.get("/trash").json() == [removed]
    reported = http.service.events.after(0, 10_000)
    assert [e.data for e in reported if e.kind == "capture.removed"] == [{"id": name}]
    assert http.delete("/trash").json() == [], "it is kept for 30 days"
    assert http.post(f"/trash/{removed['name']}/restore").json()["id"] == name
    assert {p.name: p.stat().st_size for p in path.rglob("*") if p.is_file()} == before
    assert verify(path) == []
    assert [c["outcome"] for c in http.get("/captures").json()] == ["completed"]
    reported = http.service.events.after(0, 10_000)
    assert [e.data for e in reported if e.kind == "capture.restored"] == [{"id": name}]
    http.delete(f"/captures/{name}")
    gone = http.delete("/trash", params={"older_than_days": 0, "dry_run": True}).json()
    assert http.delete("/trash", params={"older_than_days": 0}).json() == gone
    assert http.get("/trash").json() == []
    actions = [a["action"] for a in http.get("/audit").json() if a["subject"] == name]
    assert [a for a in actions if a != "capture.end"][1:] == [
        *("capture.remove", "capture.restore", "capture.remove", "capture.delete")
    ]


def _files(path: Path) -> list[Path]:
    return [p for p in path.rglob("*") if p.is_file()]


def test_captures_and_models_in_use_cannot_be_removed(http, world):
    world.busy = {"cam_1": 10**9}
    running = http.post("/captures", json={"plan": SHORT}).json()["id"]
    for method in (http.delete, http.get):
        path = f"/captures/{running}" + ("/archive.tar" if method == http.get else "")
        assert method(path).status_code == 409
    assert slug(http.delete(f"/captures/{running}")) == "wrong-state"
    http.post("/devices/blackout")
    until(lambda: http.get(f"/captures/{running}").json()["state"] == "done")
    world.busy = {}
    capture = shot(http)
    requested = {"capture": capture["id"], "pipeline": {"name": "reconstruct"}, "model": "mine"}
    job = http.post("/jobs", json=requested).json()["id"]
    Model(http.service.root / "models" / "mine").create().write_json("results.json", {"a": 1})
    assert job in http.delete(f"/captures/{capture['id']}").json()["detail"]
    assert slug(http.delete("/models/mine")) == "in-use"
    http.delete(f"/jobs/{job}")
    with (Path(capture["path"]) / "journal.jsonl").open("ab") as journal:
        fcntl.flock(journal, fcntl.LOCK_EX)  # as a compression has it
        assert slug(http.delete(f"/captures/{capture['id']}")) == "journal-in-use"
    assert [m["name"] for m in http.get("/models").json()] == ["mine"]
    archive = http.get("/models/mine/archive.tar").content
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        results = tar.extractfile("mine/results.json")
        assert results is not None
        assert json.load(results) == {"a": 1}
    assert http.delete(f"/captures/{capture['id']}").json()["models"] == ["mine"]
    assert http.delete("/models/mine").json()["kind"] == "model"
    assert slug(http.get("/models/mine/archive.tar")) == "not-there"
    assert slug(http.delete("/models/..")) in ("http", "not-there")


def test_a_job_that_was_just_enqueued_under_the_key_is_that_one(http, monkeypatch):
    requested = {"capture": shot(http)["id"], "pipeline": {"name": "reconstruct"}}
    key = {"Idempotency-Key": "once"}
    job = http.post("/jobs", json=requested, headers=key).json()["id"]
    get, not_yet = http.service._queue.get, iter([NoSuchJob("not yet")])

    def looked(name: str) -> Any:
        for error in not_yet:  # as when the first request is still under way
            raise error
        return get(name)

    monkeypatch.setattr(http.service._queue, "get", looked)
    again = http.post("/jobs", json=requested, headers=key)
    assert (again.status_code, again.json().get("id")) == (202, job)


def test_a_key_belongs_to_one_caller_and_one_request(rig_file, world, tmp_path):
    """F17: another body, or another caller, got the first job without a word."""
    tokens = Tokens(tmp_path / "tokens.json", "own")
    eve = {"Authorization": f"Bearer {tokens.make('eve', ('read', 'jobs'))}"}
    with serving(rig_file, tmp_path / "root", Access(tokens)) as http:
        http.headers["Authorization"] = "Bearer own"
        requested = {"capture": shot(http)["id"], "pipeline": {"name": "reconstruct"}, "model": "a"}
        key = {"Idempotency-Key": "once"}
        first = http.post("/jobs", json=requested, headers=key).json()["id"]
        other = http.post("/jobs", json={**requested, "model": "b"}, headers=key)
        assert (other.status_code, slug(other)) == (409, "key-used")
        assert first in other.json()["detail"]
        hers = http.post("/jobs", json={**requested, "model": "c"}, headers={**eve, **key})
        assert hers.status_code == 202
        assert hers.json()["id"] != first


def test_archives_are_listed_one_at_a_time(rig_file, tmp_path, monkeypatch):
    root, inside, together = tmp_path / "root", [], []
    Model(root / "models" / "m").create().write_json("results.json", {})
    listed = storage.files_of

    def files_of(what: str, folder: Path) -> dict[str, Path]:
        inside.append(what)
        time.sleep(0.05)
        together.append(len(inside))
        inside.remove(what)
        return listed(what, folder)

    monkeypatch.setattr("stage_service.api.store.files_of", files_of)
    with serving(rig_file, root) as http, ThreadPoolExecutor(6) as pool:
        got = pool.map(lambda _: http.get("/models/m/archive.tar").status_code, range(6))
        assert list(got) == 6 * [200]
    assert together == 6 * [1]


def test_removal_needs_its_scopes(rig_file, world, tmp_path):
    tokens = Tokens(tmp_path / "tokens.json", "own")
    steers = {"Authorization": f"Bearer {tokens.make('eve', ('read', 'steer'))}"}
    with serving(rig_file, tmp_path / "root", Access(tokens)) as http:
        http.headers["Authorization"] = "Bearer own"
        whole = shot(http)["id"]
        with world.held():
            stopped = http.post("/captures", json={"plan": {"projectors": []}}).json()["id"]
            http.post(f"/captures/{stopped}/abort")
        until(lambda: http.get(f"/captures/{stopped}").json()["state"] == "done")
        for method in (
            lambda: http.delete(f"/captures/{whole}", headers=steers),
            lambda: http.delete("/trash", headers=steers),
            lambda: http.delete("/models/any", headers=steers),
            lambda: http.post("/trash/any/restore", headers=steers),
        ):
            assert slug(method()) == "forbidden"
        assert http.delete(f"/captures/{stopped}", headers=steers).status_code == 200
        assert http.delete(f"/captures/{whole}").status_code == 200


def test_files_that_a_job_removes_while_they_are_listed_are_left_out(http, monkeypatch):
    capture = shot(http)
    pipeline = {"name": "reconstruct", "options": {"method": "auto"}}
    job = http.post("/jobs", json={"capture": capture["id"], "pipeline": pipeline}).json()
    model = Path(job["model"])
    model.mkdir(parents=True)
    (model / "strands.npz").write_bytes(b"kept")
    list_all = Model.artifacts

    def and_one_more(self):
        return {**list_all(self), "relit.png": self.path / "relit.png"}  # removed since

    monkeypatch.setattr(Model, "artifacts", and_one_more)
    (listed,) = http.get("/models").json()
    assert (listed["name"], listed["files"]) == (model.name, ["strands.npz"])
    assert listed["bytes"] == 4
    files = http.get(f"/jobs/{job['id']}/artifacts").json()
    assert files == [{"path": "strands.npz", "bytes": 4}]
    for path in (f"/models/{model.name}/archive.tar", f"/jobs/{job['id']}/artifacts/relit.png"):
        assert slug(http.get(path)) == "in-use"


def test_a_snapshot_is_there_until_the_next_one_whatever_becomes_of_the_service(rig_file, tmp_path):
    root = tmp_path / "root"
    with serving(rig_file, root) as http:
        http.post("/snapshot", json={"light": "light_003"})
        until(lambda: http.get("/captures/snapshot").json()["state"] == "done")
    with serving(rig_file, root) as http:
        assert http.get("/captures/snapshot").json()["outcome"] == "completed"
        assert http.get("/captures/snapshot/steps").json()[0]["light"] == "light_003"
        assert http.get("/captures").json() == []


def test_head_and_masks_are_uploaded_checked_and_used(http, monkeypatch):
    masks = {f"cam_{i}": np.eye(6, 8, dtype=np.uint8) * 255 for i in range(3)}
    png = {name: cv2.imencode(".png", mask)[1].tobytes() for name, mask in masks.items()}
    assert http.put("/uploads/anna/head.obj", content=HEAD).json()["files"] == ["head.obj"]
    assert http.put("/uploads/anna/masks/cam_1.png", content=png["cam_1"]).status_code == 200
    capture = Capture(shot(http, upload="anna")["path"])
    assert capture.head is not None
    np.testing.assert_array_equal(capture.mask("cam_1"), masks["cam_1"] > 0)
    assert capture.mask("cam_0") is None
    small = cv2.imencode(".png", masks["cam_0"][:3])[1].tobytes()
    for name, data in (
        ("head.obj", b"v 0 0 0\n"),
        ("head.obj", b"\xff\xfe\0"),
        ("masks/cam_9.png", png["cam_0"]),
        ("masks/cam_0.png", small),
        ("masks/cam_0.png", png["cam_0"][:40]),
        ("masks/cam_0.png", b"GIF89a"),
    ):
        assert slug(http.put(f"/uploads/anna/{name}", content=data)) == "bad-input", name
    for subject in ("..", ".hidden", "%2e%2e", "a" * 200):
        refused = http.put(f"/uploads/{subject}/head.obj", content=HEAD)
        assert refused.status_code in (404, 422), subject
    assert sorted(p.name for p in (http.service.root / "uploads").iterdir()) == ["anna"]
    assert slug(http.post("/captures", json={"upload": "bert"})) == "not-there"
    both = {"upload": "anna", "head": "/x.obj"}
    assert slug(http.post("/captures", json=both)) == "bad-input"
    monkeypatch.setattr(bodies, "MOST_UPLOAD", 3 << 20)
    large = HEAD + b"# " + b"x" * (2 << 20)
    assert http.put("/uploads/anna/head.obj", content=large).status_code == 200
    assert slug(http.put("/uploads/anna/head.obj", content=2 * large)) == "too-large"
    assert slug(http.post("/plans:validate", content=large)) == "too-large"
    assert http.delete("/uploads/anna").json()["files"] == ["head.obj", "masks/cam_1.png"]
    assert http.get("/uploads").json() == []


def test_a_head_that_is_uploaded_twice_at_once_is_one_of_the_two(http):
    heads = [HEAD + n * b"# the same head again\n" for n in (1000, 20_000)]
    responses: list[int] = []

    def put(head: bytes) -> None:
        responses.append(http.put("/uploads/anna/head.obj", content=head).status_code)

    for _ in range(4):
        threads = [threading.Thread(target=put, args=(head,)) for head in heads]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert (http.service.root / "uploads" / "anna" / "head.obj").read_bytes() in heads
    assert responses == 8 * [200]


def test_concurrent_deletions_delete_once(http):
    root = http.service.root
    removed = {"kind": "capture", "by": "eve", "removed": "2026-01-01T00:00:00.000+00:00"}
    responses: list[int] = []

    def delete(path: str) -> None:
        responses.append(http.delete(path).status_code)

    for _ in range(4):
        for name in ("a", "b", "c"):
            (root / "uploads" / name / "masks").mkdir(parents=True)
            place = root / "trash" / f"20260101-000000-{name}"
            (place / name).mkdir(parents=True)
            reported = {**removed, "name": place.name, "id": name, "bytes": 0}
            (place / "removed.json").write_text(json.dumps(reported))
            for i in range(50):
                (place / name / f"{i}").touch()
                (root / "uploads" / name / "masks" / f"{i}.png").touch()
        paths = [2 * ["/trash"], *(2 * [f"/uploads/{name}"] for name in ("a", "b", "c"))]
        for twice in paths:
            threads = [threading.Thread(target=delete, args=(path,)) for path in twice]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
    assert set(responses) <= {200, 404}
    assert responses.count(404) <= 12
    assert http.get("/trash").json() == http.get("/uploads").json() == []


def test_interrupted_deletions_are_listed_until_completed(http, monkeypatch):
    capture = shot(http)
    removed = http.delete(f"/captures/{capture['id']}").json()
    place = Path(capture["path"]).parents[1] / "trash" / removed["name"]
    delete = shutil.rmtree

    def cut_short(folder):
        """Deletes as any disk may order it, the smallest file first, and dies."""
        min(_files(folder), key=lambda file: file.stat().st_size).unlink()
        raise OSError("the power is gone")

    monkeypatch.setattr(shutil, "rmtree", cut_short)
    stuck = http.delete("/trash", params={"older_than_days": 0})
    assert slug(stuck) == "not-removed"
    assert "the power is gone" in stuck.json()["problems"][0]
    monkeypatch.setattr(shutil, "rmtree", delete)
    assert _files(place)
    left = {**removed, "problem": "its deletion was interrupted"}
    assert http.get("/trash").json() == [left]
    assert slug(http.post(f"/trash/{removed['name']}/restore")) == "not-there"
    assert http.delete("/trash", params={"older_than_days": 0}).json() == [left]
    assert not place.exists()


def test_a_refusal_reaches_a_client_that_sends_on(http):
    """What a connection was told is lost where it is closed before all was read."""
    size = 4 * bodies.MOST_BODY
    host, port = http.base_url.host, http.base_url.port
    head = f"POST /plans:validate HTTP/1.1\r\nHost: {host}:{port}\r\nContent-Length: {size}\r\n\r\n"
    with socket.create_connection((host, port), timeout=60) as connection:
        connection.sendall(head.encode())
        connection.recv(1, socket.MSG_PEEK)  # the refusal is there
        connection.sendall(size * b" ")
        response = b"".join(iter(lambda: connection.recv(1 << 16), b""))
    assert response.startswith(b"HTTP/1.1 413")
    assert json.loads(response.partition(b"\r\n\r\n")[2])["type"].endswith("too-large")


def test_the_command_line_of_the_store(http, tmp_path, capsys):
    def run(*words: str) -> dict[str, Any]:
        assert main([*words, "--url", str(http.base_url), "--json"]) == 0
        found: dict[str, Any] = json.loads(capsys.readouterr().out)
        return found

    (tmp_path / "head.obj").write_bytes(HEAD)
    run("store", "upload", "anna", "--head", str(tmp_path / "head.obj"))
    plan = json.dumps(SHORT)
    (tmp_path / "plan.json").write_text(plan)
    begun = run(
        *("capture", "start", "--plan", str(tmp_path / "plan.json"), "--upload", "anna"), "--wait"
    )
    name = begun["capture"]["id"]
    out = tmp_path / "capture.tar"
    run("store", "download", "capture", name, "--out", str(out))
    assert out.read_bytes() == http.get(f"/captures/{name}/archive.tar").content
    assert run("store", "remove", "capture", name, "--dry-run")["name"] is None
    trashed = run("store", "remove", "capture", name)["name"]
    assert [t["name"] for t in run("store", "trash")["trash"]] == [trashed]
    run("store", "restore", trashed)
    run("store", "remove", "capture", name)
    assert len(run("store", "empty", "--older-than-days", "0")["trash"]) == 1


def test_the_command_line_takes_names_as_they_are(http, capsys):
    capture = shot(http)
    captures = Path(capture["path"]).parent
    for name in ("anna", "anna#2", "anna?dry_run=true", "anna 100%"):
        shutil.copytree(capture["path"], captures / name)
        http.service._captures.catalogue.adopt(name)
    for name in ("anna#2", "anna?dry_run=true", "anna 100%"):
        assert main(["store", "remove", "capture", name, "--url", str(http.base_url)]) == 0
        assert not (captures / name).exists()
    assert (captures / "anna").is_dir()
    assert main(["capture", "show", "anna#3", "--url", str(http.base_url)]) == 3
    assert "there is no capture 'anna#3'" in capsys.readouterr().err


def test_the_command_line_lists_all_there_are(http, capsys, monkeypatch):
    capture = shot(http)
    for i in range(1100):
        one = CaptureStatus.model_validate(capture | {"id": f"c{i:04d}"})
        http.service._captures.catalogue.put(one)
    assert main(["capture", "list", "--json", "--url", str(http.base_url)]) == 0
    listed = [c["id"] for c in json.loads(capsys.readouterr().out)["captures"]]
    assert listed == [capture["id"], *(f"c{i:04d}" for i in range(1100))]


def test_a_foreign_service_is_reported_as_such(capsys):
    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(404 if self.path == "/health" else 200)
            self.end_headers()
            self.wfile.write(b"<html>")

        def log_message(self, *_: Any) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Page) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        for words in (["stage", "status"], ["lease", "show"]):
            url = f"http://127.0.0.1:{server.server_port}"
            assert main([*words, "--url", url]) == 4
            reported = capsys.readouterr().err
            assert "no document of hairstage" in reported
            assert "Traceback" not in reported
        server.shutdown()
