"""Who may steer, what is refused while nobody knows what is lit, and the record of it all."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest
from serving import Client, serving
from waiting import until

from reconstruction import verify
from stage_service.cli import main
from stage_service.config import RigFile, SafetyLimits
from stage_service.devices.device_set import DeviceSet

SHORT = {"lights": ["light_003", "light_000"], "projectors": []}
IN_BAND = {**SHORT, "lights": "all", "exposure": {"olat": 0.05}}
CONSENT = "N. N., 3 May 2026, flashes of 14 Hz for ten seconds"


def refused(response: httpx.Response, slug: str) -> dict[str, Any]:
    data: dict[str, Any] = response.json()
    assert data["type"] == f"/docs/errors.md#{slug}", data
    assert data["status"] == response.status_code
    return data


def done(http: Client, capture: str) -> dict[str, Any]:
    http.service._captures.wait(capture, 120)
    status: dict[str, Any] = http.get(f"/captures/{capture}").json()
    assert status["state"] == "done"
    return status


def audit(http: Client) -> list[tuple[str, str, str]]:
    """(who, action, result) of each, the caller's port left out."""
    entries = http.get("/audit").json()
    return [(re.sub(r":\d+", "", a["who"]), a["action"], a["result"]) for a in entries]


def test_without_a_lease_anybody_steers_and_with_one_its_holder(http, world):
    assert http.get("/lease").json() == {"holder": None, "expires": None}
    with world.held():
        capture = http.post("/captures", json={"plan": {"projectors": []}}).json()["id"]
        granted = http.post("/lease", json={"holder": "Ada", "seconds": 60}).json()
        mine = {"Hairstage-Lease": granted["token"]}
        assert http.get("/lease").json() == {"holder": "Ada", "expires": granted["expires"]}
        for other in ({}, {"Hairstage-Lease": "guessed"}):
            for path in ("/captures", f"/captures/{capture}/pause", f"/captures/{capture}/resume"):
                problem = refused(http.post(path, headers=other, json={}), "leased")
                assert (problem["holder"], problem["expires"]) == ("Ada", granted["expires"])
        refused(http.post("/lease", json={"holder": "Eve"}), "leased")
        assert http.post(f"/captures/{capture}/pause", headers=mine).is_success
        assert http.post(f"/captures/{capture}/abort").is_success, "anybody may abort"
    assert done(http, capture)["outcome"] == "aborted"
    assert http.post("/devices/blackout").json()["state"] == "dark"

    later = http.patch("/lease", headers=mine, json={"seconds": 600}).json()
    assert later["expires"] > granted["expires"]
    refused(http.patch("/lease", json={}), "no-lease")
    refused(http.delete("/lease"), "no-lease")
    assert http.delete("/lease", headers=mine).json()["holder"] is None
    assert ("Ada (127.0.0.1)", "capture.pause", "ok") in audit(http)
    assert ("127.0.0.1", "capture.pause", "refused") in audit(http)


def test_the_command_line_steers_under_a_lease(http, tmp_path, capsys):
    def run(*words: str) -> tuple[int, dict[str, Any]]:
        code = main([*words, "--url", str(http.base_url), "--json"])
        return code, json.loads(capsys.readouterr().out)

    plan = tmp_path / "plan.json"
    plan.write_text(json.dumps(SHORT))
    start = ("capture", "start", "--plan", str(plan), "--wait")
    code, output = run(*start)
    assert (code, output["capture"]["outcome"]) == (0, "completed")
    assert run("lease", "show")[1]["holder"] is None, "released at the end"
    assert audit(http)[0][1] == "lease.take"
    assert audit(http)[-1][1:] == ("lease.release", "ok")

    token = run("lease", "take", "--holder", "Ada")[1]["token"]
    code, output = run(*start)
    assert (code, output["error"]["problem"]["holder"]) == (1, "Ada")
    assert run(*start, "--lease", token)[0] == 0
    assert run("lease", "renew", "--lease", token)[1]["holder"] == "Ada"
    assert run("lease", "release", "--lease", token)[1]["holder"] is None
    code, output = run("capture", "resume", reported_id(http), "--armed-by", "Ada")
    assert (code, output["error"]["problem"]["type"]) == (1, "/docs/errors.md#wrong-state")


def test_the_command_line_darkens_and_says_what_it_knows(http, world, capsys):
    def run(*words: str) -> tuple[int, str]:
        code = main(["stage", *words, "--url", str(http.base_url)])
        output = capsys.readouterr()
        return code, output.out + output.err

    assert run("status") == (0, "ok: lamps dark, no capture runs, no worker runs\n")
    world.lit = {2}
    code, output = run("blackout")
    assert (code, world.lit, output.partition(":")[0]) == (0, set(), "dark")
    code, output = run("acknowledge", "Ada", "all dark, I looked")
    assert (code, "nothing to acknowledge" in output) == (1, True), output
    world.lit, world.stuck_lamps = {7}, True
    code, output = run("blackout")
    assert (code, output.partition(":")[0]) == (1, "unknown, unsafe")
    assert run("status")[1].startswith("unsafe: lamps unknown, unsafe, no capture runs")


def reported_id(http: Client) -> str:
    capture: str = http.get("/captures").json()[0]["id"]
    return capture


def test_a_stage_that_is_not_dark_is_latched_and_stays_so_over_a_restart(rig_file, world, tmp_path):
    root = tmp_path / "root"
    with serving(rig_file, root) as http:
        assert http.get("/devices").json()["safety"]["state"] == "dark"
        world.lit, world.stuck_lamps = {7}, True
        assert http.post("/devices/blackout").json()["state"] == "unknown, unsafe"
        problem = refused(http.post("/captures", json={"plan": SHORT}), "unsafe")
        assert "putting all lamps off" in problem["detail"]
        safety = http.get("/devices").json()["safety"]
        assert safety["latched"] is not None
    with serving(rig_file, root) as http:
        assert http.get("/devices").json()["safety"]["latched"] == safety["latched"]
        refused(http.post("/captures", json={"plan": SHORT}), "unsafe")
        word = {"name": "Ada", "note": "all dark, I looked"}
        problem = refused(http.post("/devices/acknowledge", json=word), "cannot-acknowledge")
        assert "send a blackout" in problem["detail"]
        world.stuck_lamps = False
        assert http.post("/devices/blackout").json()["safe"]
        refused(http.post("/devices/acknowledge", json=word), "cannot-acknowledge")
        capture = http.post("/captures", json={"plan": SHORT}).json()["id"]
        assert done(http, capture)["outcome"] == "completed"
        latch = [a for _, a, _ in audit(http) if a.startswith("latch")]
        assert latch == ["latch.set", "latch.cleared"]


def test_a_person_clears_the_latch_of_a_link_without_read_back(unread_rig, world, tmp_path, capsys):
    with serving(unread_rig, tmp_path / "root") as http:
        world.deaf_lights = True
        assert http.post("/devices/blackout").json()["state"] == "unknown, unsafe"
        entry = http.post("/queue", json={"plan": SHORT}).json()["id"]
        assert "until somebody has looked" in http.get("/queue").json()["waits_for"]
        world.deaf_lights = False
        before = http.service.events.last
        word = {"name": "Ada", "note": "all dark, I looked"}
        looked = "somebody has looked: Ada: all dark, I looked"
        dark = {"state": "said to be dark", "detail": looked, "latched": None, "accepted": False}
        assert http.post("/devices/acknowledge", json=word).json() == dark
        assert http.get("/devices").json()["safety"] == dark
        output = {e.kind: e.data for e in http.service.events.after(before, 99)}
        assert output["stage.lamps"] == dark
        unlatched = {"latched": False, "safe": False, "state": dark["state"], "detail": looked}
        assert output["stage.latch"] == unlatched
        recorded = [(a["action"], a["detail"]) for a in http.get("/audit").json()[-2:]]
        assert recorded == [("latch.cleared", looked), ("acknowledge", "Ada: all dark, I looked")]
        main(["stage", "status", "--url", str(http.base_url)])
        first, second = capsys.readouterr().out.splitlines()
        assert first.startswith("ok: lamps said to be dark, no capture runs")
        assert second == looked

        # Whoever looked may still be there: it begins when somebody says so, and then by itself.
        assert "acknowledged" in http.get("/queue").json()["waits_for"]
        assert http.go_on().is_success
        capture = until(lambda: http.get("/captures").json())[0]
        assert capture["request"] == {"queue": entry}
        assert done(http, capture["id"])["outcome"] == "completed"
        health = http.get("/health").json()
        assert health["lamps"] == "unknown, unsafe", "nobody has looked since"
        assert health["lamps_accepted"], "off was sent"
        refused(http.post("/devices/acknowledge", json=word), "cannot-acknowledge")


def test_a_person_clears_a_damaged_latch_of_a_link_without_read_back(unread_rig, world, tmp_path):
    root = tmp_path / "root"
    root.mkdir()
    (root / "unsafe.json").write_text("{")
    with serving(unread_rig, root) as http:
        problem = refused(http.post("/captures", json={"plan": SHORT}), "unsafe")
        assert "could not be read" in problem["detail"]
        assert "until somebody has looked" in problem["detail"]
        health = http.get("/health").json()
        assert (health["latch"]["ended_by"], health["lamps_accepted"]) == ("acknowledge", False)
        http.post("/devices/blackout")
        refused(http.post("/captures", json={"plan": SHORT}), "unsafe")
        word = {"name": "Ada", "note": "all dark, I looked"}
        assert http.post("/devices/acknowledge", json=word).json()["state"] == "said to be dark"
        capture = http.post("/captures", json={"plan": SHORT}).json()["id"]
        assert done(http, capture)["outcome"] == "completed"


def test_a_capture_that_cannot_end_dark_latches(http, world):
    world.stuck_lamps = True
    capture = http.post("/captures", json={"plan": SHORT}).json()["id"]
    assert done(http, capture)["outcome"] == "failed"
    refused(http.post("/captures", json={"plan": SHORT}), "unsafe")
    refused(http.post(f"/captures/{capture}/resume"), "unsafe")


def test_the_service_starts_dark_and_starts_without_its_devices(rig_file, world, tmp_path):
    world.lit, world.show = {1, 2}, "ON 65535"
    with serving(rig_file, tmp_path / "a"):
        assert (world.lit, world.show) == (set(), "OFF")
    assert rig_file.devices is not None
    nowhere = rig_file.devices.lights.model_copy(update={"port": 1})
    away = replace(rig_file, devices=rig_file.devices.model_copy(update={"lights": nowhere}))
    with serving(away, tmp_path / "b") as http:
        health = http.get("/health").json()
        assert (health["status"], health["lamps"]) == ("unsafe", "unknown, unsafe")
        assert "light bank" in health["problems"][0]
        refused(http.post("/captures", json={"plan": SHORT}), "unsafe")
    with serving(rig_file, tmp_path / "b") as http:  # they are there again: dark at the start
        assert http.get("/devices").json()["safety"] == {
            "state": "dark",
            "detail": "every lamp and projector was read back dark",
            "latched": None,
            "accepted": False,
        }


def with_subject(rig_file: RigFile, **cameras: Any) -> RigFile:
    """The rig before a living subject."""
    assert rig_file.devices is not None
    of = rig_file.devices.cameras.model_copy(update=cameras)
    devices = rig_file.devices.model_copy(update={"cameras": of})
    return replace(rig_file, safety=SafetyLimits(), devices=devices)


def test_flashes_in_the_band_need_consent_and_somebody_who_arms_them(rig_file, world, tmp_path):
    with serving(with_subject(rig_file), tmp_path / "root") as http:
        flash = http.post("/plans:validate", json=IN_BAND).json()["flash"]
        assert (flash["band"], flash["needs_consent"]) == ("3 to 30 Hz", True)
        assert flash["hz"] == pytest.approx(1 / 0.072, rel=0.01)
        problem = refused(http.post("/captures", json={"plan": IN_BAND}), "flash-rate")
        assert "13.9 Hz" in problem["problems"][0]
        assert "no consent is recorded" in problem["problems"][0]
        assert "rate_hz to 2.5" in problem["problems"][1]
        assert "82 s instead of 14 s" in problem["problems"][1]
        agreed = {**IN_BAND, "consent": CONSENT}
        problem = refused(http.post("/captures", json={"plan": agreed}), "flash-rate")
        assert "the operator has not armed it" in problem["problems"][0]
        refused(http.post("/captures", json={"plan": IN_BAND, "armed_by": "Ada"}), "flash-rate")
        assert world.pulses == 0
        begun = http.post("/captures", json={"plan": agreed, "armed_by": "Ada"})
        assert begun.status_code == 202
        http.post(f"/captures/{begun.json()['id']}/abort")
        for nobody in (
            {"plan": agreed, "armed_by": " "},
            {"plan": IN_BAND | {"consent": 12 * " "}},
        ):
            refused(http.post("/captures", json={"armed_by": "Ada", **nobody}), "invalid-request")
        nothing = {"name": "  ", "note": "    "}
        refused(http.post("/devices/acknowledge", json=nothing), "invalid-request")
        refused(http.post("/lease", json={"holder": " "}), "invalid-request")
        armed = [a for a in http.get("/audit").json() if a["action"] == "flash.armed"]
        assert [a["detail"] for a in armed] == [f"armed by Ada; consent: {CONSENT}"]


def test_a_plan_that_flashes_otherwise_than_predicted_is_stopped(rig_file, world, tmp_path):
    slow = with_subject(rig_file, readout_s=0.5)  # predicted: less than two steps a second
    with serving(slow, tmp_path / "root") as http:
        capture = http.post("/captures", json={"plan": IN_BAND}).json()["id"]
        status = done(http, capture)
        assert status["outcome"] == "failed"
        assert "no consent is armed" in status["error"]
        assert world.pulses < 8
        assert not world.lit


def interrupted(http: Client) -> str:
    """A capture that was aborted after some frames."""
    capture: str = http.post("/captures", json={"plan": {"projectors": []}}).json()["id"]
    events = http.service.events
    while not any(e.kind == "capture.step" for e in events.wait(0, 0)):
        assert events.wait(events.last, 10.0)
    http.post(f"/captures/{capture}/abort")
    return capture


def test_a_capture_that_was_aborted_is_continued_where_it_stopped(http, world):
    capture = interrupted(http)
    stopped = done(http, capture)
    assert 0 < stopped["frames_written"] < stopped["frames_planned"]
    pulses = world.pulses
    begun = http.post(f"/captures/{capture}/resume")
    assert begun.status_code == 200, begun.text
    assert [c["id"] for c in http.get("/captures").json()] == [capture]
    status = done(http, capture)
    assert (status["outcome"], status["error"]) == ("completed", None)
    assert status["frames_written"] == status["frames_planned"]
    assert world.pulses == status["steps"] - pulses, "only what was missing was shot"
    assert verify(Path(status["path"])) == []
    problem = refused(http.post(f"/captures/{capture}/resume"), "wrong-state")
    assert "possible now: nothing" in problem["detail"]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda r: {"rig": replace(r.rig, lights=r.rig.lights[::-1])}, "the rig has changed"),
        (
            lambda r: {"capture": r.capture.model_copy(update={"tracking_every": 3})},
            "and with it the steps",
        ),
        (lambda r: {"safety": SafetyLimits(max_lamps=3)}, "max_lamps allows 3"),
    ],
    ids=["rig", "defaults", "limits"],
)
def test_a_capture_is_not_continued_on_another_stage(
    rig_file: RigFile,
    tmp_path: Path,
    change: Callable[[RigFile], dict[str, Any]],
    why: str,
) -> None:
    with serving(rig_file, tmp_path / "root") as http:
        plan = {"lights": [f"light_{i:03}" for i in range(40)], "rows": {"last": 5}}
        capture = http.post("/captures", json={"plan": plan}).json()["id"]
        http.post("/devices/blackout")
        assert done(http, capture)["outcome"] == "aborted"
    with serving(replace(rig_file, **change(rig_file)), tmp_path / "root") as http:
        problem = refused(http.post(f"/captures/{capture}/resume"), "invalid-plan")
        assert why in problem["detail"]
        assert http.get(f"/captures/{capture}").json()["outcome"] == "aborted"


def test_a_capture_of_a_plan_of_another_version_is_not_continued(http):
    """Every second row: plans of earlier versions could have that."""
    capture = interrupted(http)
    file = Path(done(http, capture)["path"]) / "plan.json"
    output = json.loads(file.read_text())
    output["plan"]["rows"]["step"] = 2
    file.write_text(json.dumps(output))
    problem = refused(http.post(f"/captures/{capture}/resume"), "invalid-plan")
    assert "plan is not of this version: rows.step: Input should be 1" in problem["detail"]
    assert done(http, capture)["outcome"] == "aborted"


def test_the_stage_keeps_the_limits_of_the_rig_file(rig_file, permitted):
    lights = DeviceSet.of(replace(rig_file, safety=SafetyLimits(max_lamps=5))).lights
    with pytest.raises(RuntimeError, match="max_lamps"):
        lights.all_on()
    lights.close()
