"""The queue of captures: what begins by itself, in which order, and what never does."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from serving import Client, serving, slug
from waiting import until

from stage_service.captures import capture_queue
from stage_service.captures.manager import CaptureManager
from stage_service.captures.may_light import NotNow, Word
from stage_service.cli import main
from stage_service.cli.support.client import ServiceClient
from stage_service.config import SafetyLimits
from stage_service.plan.capture_plan import CapturePlan

LONG = {"projectors": [], "lights": [f"light_{i:03d}" for i in range(60)]}
IN_BAND = {"projectors": [], "exposure": {"olat": 0.05}}
CONSENT = "N. N., 3 May 2026, flashes of 14 Hz for ten seconds"


def plan(light: int) -> dict[str, Any]:
    """One that only its light tells from others."""
    return {"plan": {"lights": [f"light_{light:03d}"], "projectors": []}}


def add(http: Client, body: dict[str, Any]) -> str:
    response = http.post("/queue", json=body)
    assert response.status_code == 201, response.text
    entry: str = response.json()["id"]
    return entry


def ended(http: Client, number: int) -> list[dict[str, Any]]:
    """The captures, oldest first, once so many are done."""

    def there() -> list[dict[str, Any]] | None:
        captures: list[dict[str, Any]] = http.get("/captures").json()
        done = len(captures) == number and all(c["state"] == "done" for c in captures)
        return captures if done else None

    found = until(there, pause=0.05)
    assert found is not None
    return found


def test_queued_captures_start_in_their_order(http):
    http.go_on()
    running = http.post("/captures", json={"plan": LONG}).json()["id"]
    a, b, c = (add(http, plan(i)) for i in range(3))
    first = add(http, {**plan(3), "place": 0})
    assert running in http.get("/queue").json()["waits_for"]
    assert http.patch(f"/queue/{c}", json={"place": 1}).json()["id"] == c
    assert http.delete(f"/queue/{a}").json()["state"] == "removed"
    assert [e["id"] for e in http.get("/queue").json()["waiting"]] == [first, c, b]
    captures = ended(http, 4)
    assert [x["outcome"] for x in captures] == 4 * ["completed"]
    by_start = sorted(captures, key=lambda x: x["started"])
    assert [x["request"].get("queue") for x in by_start] == [None, first, c, b]
    history = http.get("/queue/history").json()
    shot = [(e["id"], e["capture"]) for e in history if e["state"] == "started"]
    assert shot == [(x["request"]["queue"], x["id"]) for x in by_start[:0:-1]]
    assert [e["id"] for e in history if e["state"] == "removed"] == [a]
    assert http.get("/queue").json() == {
        "held": None,
        "hold": None,
        "waits_for": None,
        "waiting": [],
    }
    audit = [(x["who"], x["subject"]) for x in http.get("/audit").json()]
    assert len([who for who, subject in audit if "queue, for 127.0.0.1" in who]) == 3
    assert slug(http.patch(f"/queue/{a}", json={"place": 0})) == "unknown-entry"
    assert slug(http.delete(f"/queue/{a}")) == "unknown-entry"


@pytest.mark.parametrize("how", ["abort", "blackout", "failure"])
def test_after_abort_blackout_or_failure_the_queue_waits_for_a_person(http, world, how):
    http.go_on()
    running = http.post("/captures", json={"plan": LONG}).json()["id"]
    entry = add(http, plan(1))
    if how == "failure":
        world.dead_lamps = True
    else:
        http.post({"abort": f"/captures/{running}/abort", "blackout": "/devices/blackout"}[how])
    until(lambda: http.get(f"/captures/{running}").json()["state"] == "done")
    world.dead_lamps = False
    reason = until(lambda: http.get("/queue").json()["held"])
    assert {"abort": "abort of capture", "blackout": "blackout by", "failure": "failed"}[
        how
    ] in reason
    pulses = world.pulses
    # Long enough for the queue's thread to have looked once more.
    http.service.events.wait(http.service.events.last, 1.2)
    assert world.pulses == pulses
    assert [e["id"] for e in http.get("/queue").json()["waiting"]] == [entry]
    assert http.go_on().json()["held"] is None
    assert ended(http, 2)[1]["request"] == {"queue": entry}


def test_abort_of_a_missing_or_finished_capture_is_refused_with_the_reason(http):
    done = http.post("/captures", json=plan(3)).json()["id"]
    http.service._captures.wait(done, 30)
    http.go_on()
    http.post("/lease", json={"holder": "Ada"})  # so that what waits does
    add(http, plan(4))
    assert slug(http.post("/captures/20260101-000000-0000/abort")) == "unknown-capture"
    assert http.get("/queue").json()["held"] is None
    over = http.post(f"/captures/{done}/abort").json()
    assert over["detail"].endswith("that is done (completed); possible now: nothing")
    assert "abort of capture" in http.get("/queue").json()["held"]
    refused = [a for a in http.get("/audit").json() if a["action"] == "capture.abort"]
    assert [a["result"] for a in refused] == ["refused", "refused"]


def test_nothing_begins_while_the_stage_is_latched_or_somebody_steers(http, world):
    lease = http.post("/lease", json={"holder": "Ada", "seconds": 60}).json()["token"]
    entry = add(http, plan(1))
    assert "Ada steers" in http.get("/queue").json()["waits_for"]
    assert slug(http.post(f"/queue/{entry}/start")) == "leased"
    assert slug(http.go_on()) == "leased"
    world.stuck_lamps, world.lit = True, {3}
    assert http.post("/devices/blackout").json()["safe"] is False
    http.delete("/lease", headers={"Hairstage-Lease": lease})
    http.go_on()
    assert "Nothing is lit until" in http.get("/queue").json()["waits_for"]
    assert slug(http.post(f"/queue/{entry}/start")) == "unsafe"
    assert http.get("/captures").json() == []
    world.stuck_lamps = False
    assert http.post("/devices/blackout").json()["safe"] is True
    http.go_on()
    assert ended(http, 1)[0]["outcome"] == "completed"


def test_a_flashing_plan_needs_a_responsible_person_to_start(rig_file, world, tmp_path):
    living = replace(rig_file, safety=SafetyLimits(living_subject=True))
    with serving(living, tmp_path / "root") as http:
        http.go_on()
        assert slug(http.post("/queue", json={"plan": IN_BAND})) == "flash-rate"
        flashing = add(http, {"plan": {**IN_BAND, "consent": CONSENT}})
        behind = add(http, {"plan": {**IN_BAND, "rate_hz": 2.5, "lights": ["light_003"]}})
        http.service.events.wait(http.service.events.last, 1.2)
        assert "a person at the stage" in http.get("/queue").json()["waits_for"]
        assert world.pulses == 0
        refused = http.post(f"/queue/{flashing}/start", json={})
        assert slug(refused) == "flash-rate"
        assert world.pulses == 0
        begun = http.post(f"/queue/{flashing}/start", json={"armed_by": "Eve"})
        assert begun.status_code == 202, begun.text
        http.post(f"/captures/{begun.json()['capture']}/abort")
        assert any(a["action"] == "flash.armed" for a in http.get("/audit").json())
        assert [e["id"] for e in http.get("/queue").json()["waiting"]] == [behind]


def test_a_restart_keeps_the_queue_and_captures_nothing_twice(rig_file, tmp_path):
    root = tmp_path / "root"
    with serving(rig_file, root) as http:
        http.post("/queue:hold")
        a, b = (add(http, plan(i)) for i in range(2))
        before = tmp_path / "queue.json"
        shutil.copy(root / "queue.json", before)
        started = http.post(f"/queue/{b}/start").json()
        ended(http, 1)
    # As if it had died before it could write that `b` was started.
    shutil.copy(before, root / "queue.json")
    with serving(rig_file, root) as http:
        queue = http.get("/queue").json()
        assert [e["id"] for e in queue["waiting"]] == [a]
        assert "by 127.0.0.1" in queue["held"]
        (known,) = http.get("/queue/history").json()
        assert (known["id"], known["capture"]) == (b, started["capture"])
        http.go_on()
        assert ended(http, 2)[1]["request"] == {"queue": a}
    (root / "queue.json").write_text('{"waiting": [')
    with serving(rig_file, root) as http:
        assert "broken" in http.get("/queue").json()["held"]
        assert len(list(root.glob("queue.json.broken-*"))) == 1


@pytest.mark.parametrize("then_removed", [True, False])
def test_nothing_begins_after_a_service_that_died_in_a_capture(rig_file, tmp_path, then_removed):
    root = tmp_path / "root"
    with serving(rig_file, root) as http:
        http.post("/queue:hold")
        a, b, c = (add(http, plan(i)) for i in range(3))
        if then_removed:  # from the queue, of which another entry is removed meanwhile
            http.post(f"/queue/{a}/start")
            http.delete(f"/queue/{b}")
        else:
            http.post("/captures", json=plan(4))
        (capture,) = ended(http, 1)
    # As if it had died in the capture.
    (Path(capture["path"]) / "manifest.json").unlink()
    assert not (root / "shooting").exists()
    if not then_removed:
        (root / "shooting").write_text(f"{capture['id']}\n")
    kept = json.loads((root / "queue.json").read_text())
    (root / "queue.json").write_text(json.dumps(kept | {"held": []}))
    with serving(rig_file, root) as http:
        assert capture["id"] in http.get("/queue").json()["held"]
        assert c in [e["id"] for e in http.get("/queue").json()["waiting"]]
        assert len(http.get("/captures").json()) == 1
        http.go_on()
        ended(http, 2 + (not then_removed) * 2)
    with serving(rig_file, root) as http:  # once somebody has said so, it is over
        assert capture["id"] not in http.get("/queue").json()["held"]


def test_nothing_begins_after_a_service_that_was_ended_in_a_capture(rig_file, tmp_path):
    root = tmp_path / "root"
    with serving(rig_file, root) as http:
        capture = http.post("/captures", json={"plan": LONG}).json()["id"]
        entry = add(http, plan(1))
    with serving(rig_file, root) as http:
        assert capture in http.get("/queue").json()["held"]
        assert [e["id"] for e in http.get("/queue").json()["waiting"]] == [entry]
        http.go_on()
        ended(http, 2)


def test_the_running_capture_is_recorded_for_the_next_service(http, world):
    world.busy = {"cam_1": 10**9}
    capture = http.post("/captures", json=plan(1)).json()["id"]
    assert (http.service.root / "shooting").read_text() == f"{capture}\n"
    http.post("/devices/blackout")
    until(lambda: not (http.service.root / "shooting").exists())


def test_an_entry_that_cannot_start_holds_the_queue_with_the_reason(http, world, tmp_path):
    head = tmp_path / "head.obj"
    assert slug(http.post("/queue", json={"head": str(head)})) == "bad-input"
    head.write_text("v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\ng scalp\nf 1 2 3\n")
    http.post("/queue:hold")
    entry = add(http, {**plan(1), "head": str(head)})
    head.unlink()
    http.go_on()
    assert "head.obj" in until(lambda: http.get("/queue").json()["held"])
    assert [e["id"] for e in http.get("/queue").json()["waiting"]] == [entry]
    assert world.pulses == 0


def test_an_entry_of_another_version_is_reported_in_a_sentence(rig_file, tmp_path):
    """Every second row: plans of earlier versions could have that."""
    old = {"id": "q-1", "by": "Ada", "added": "", "request": {"plan": {"rows": {"step": 2}}}}
    (tmp_path / "queue.json").write_text(json.dumps({"held": [], "waiting": [old]}))
    with serving(rig_file, tmp_path) as http:
        refused = http.post("/queue/q-1/start")
        assert slug(refused) == "bad-input"
        assert "q-1 was queued by another version: plan.rows.step" in refused.json()["detail"]
        http.go_on()
        held = until(lambda: http.get("/queue").json()["held"])
        assert held.startswith("q-1 cannot begin: q-1 was queued by another version")
        assert "\n" not in held


def test_a_blackout_wins_over_a_capture_that_is_about_to_begin(rig_file, world, tmp_path):
    manager = CaptureManager(rig_file, tmp_path / "root")
    try:
        word = Word(given=manager.moment())
        manager.blackout()
        with pytest.raises(NotNow, match="dark meanwhile"):
            manager.start(CapturePlan(projectors=()), word=word)
        assert world.pulses == 0
    finally:
        manager.close()


def test_the_queue_takes_so_much_and_no_more(http, monkeypatch):
    http.post("/queue:hold")
    long = {"plan": {"consent": "x" * 1000, "lights": [f"light_{i:03d}" for i in range(200)]}}
    assert len(json.dumps(long)) > 3000
    monkeypatch.setattr(capture_queue, "MOST_BYTES", 10_000)
    kept = [http.post("/queue", json=long).status_code for _ in range(3)]
    assert kept == [201, 201, 409]
    assert slug(http.post("/queue", json=long)) == "queue-full"
    assert len(http.get("/queue").json()["waiting"]) == 2


def test_the_command_line_queues(http, tmp_path, capsys):
    def run(*words: str) -> dict[str, Any]:
        assert main(["queue", *words, "--url", str(http.base_url), "--json"]) == 0
        found: dict[str, Any] = json.loads(capsys.readouterr().out)
        return found

    run("hold")
    file = tmp_path / "plan.json"
    file.write_text(json.dumps(plan(2)["plan"]))
    a, b = (run("add", "--plan", str(file))["id"] for _ in range(2))
    run("move", b, "0")
    assert [e["id"] for e in run("list")["waiting"]] == [b, a]
    run("remove", b)
    run("start", a)
    assert [e["state"] for e in run("history")["history"]] == ["started", "removed"]
    assert run("go-on")["held"] is None
    ended(http, 1)


def test_the_command_line_releases_no_hold_that_it_has_not_shown(http, capsys, monkeypatch):
    """A blackout comes between its reading and its word: exit status, reason and the next step."""
    get = ServiceClient.get

    def late(service: ServiceClient, path: str) -> Any:
        found = get(service, path)
        assert http.post("/devices/blackout").status_code == 200
        return found

    monkeypatch.setattr(ServiceClient, "get", late)
    assert main(["queue", "go-on", "--url", str(http.base_url)]) != 0
    assert "blackout by" in capsys.readouterr().err
    assert "blackout by" in http.get("/queue").json()["held"]
