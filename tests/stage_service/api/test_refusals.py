"""Refused requests: in the audit log, and no more of them than a disk can take."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from serving import refused, routes_of, send, serving
from waiting import until

from stage_service.api.app import create_app
from stage_service.api.gate import Access
from stage_service.captures import control
from stage_service.captures.control import Caller, Control
from stage_service.config import RigFile
from stage_service.records import attempts, refusals
from stage_service.records.attempts import Attempts
from stage_service.records.audit import Action, AuditLog
from stage_service.records.lease import Leases
from stage_service.records.refusals import Refusals
from stage_service.records.tokens import Tokens
from stage_service.service import Service

DARK = "POST /devices/blackout"
MINE = {"Authorization": "Bearer mine"}


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def service(rig_file: RigFile, tmp_path: Path) -> Iterator[Service]:
    service = Service(rig_file, tmp_path / "root")
    yield service
    service.close()


@pytest.fixture
def tokens(tmp_path: Path) -> Tokens:
    return Tokens(tmp_path / "root" / "tokens.json", own="mine")


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def app(service: Service, tokens: Tokens, clock: Clock) -> FastAPI:
    return create_app(service, Access(tokens, attempts=Attempts(clock)))


def lines(service: Service) -> list[Action]:
    """The audit log, once what was recorded until now is in it."""
    service._captures.audit.record("test", "mark", "test")
    return [a for a in service.audit(10_000) if a.action != "mark"]


def wrong(app: FastAPI, count: int = 1, **more: Any) -> httpx.Response:
    for _ in range(count):
        response = send(app, "POST /login", {}, json={"token": "guessed"}, **more)
    return response


def test_refusals_on_what_steers_leave_a_line_and_those_on_what_shows_none(app, service, tokens):
    reader = {"Authorization": f"Bearer {tokens.make('ada', ('read',))}"}
    foreign = {**MINE, "Origin": "http://evil.example"}
    for what in ("GET /captures", "GET /audit", "POST /plans:validate"):
        refused(send(app, what, {"Authorization": "Bearer x"}), "unauthorized", 401)
    assert lines(service) == []
    expected = []
    for what, headers, kind in (
        ("POST /captures", reader, "forbidden"),
        ("POST /captures", {}, "unauthorized"),
        ("POST /lease", foreign, "foreign-origin"),
        ("POST /devices/acknowledge", {**MINE, "Host": "evil.example"}, "http"),
        ("DELETE /models/x", reader, "forbidden"),
        ("PUT /uploads/x/head.obj", reader, "forbidden"),
        ("POST /queue:hold", {"Authorization": "Bearer x"}, "unauthorized"),
    ):
        assert send(app, what, headers).status_code in (401, 403, 421)
        expected.append((what.partition(" ")[2], "refused", kind))
    found = lines(service)
    assert [(a.subject, a.result, a.detail.partition(":")[0]) for a in found] == expected
    assert (found[0].who, found[0].action) == ("ada (127.0.0.1:123)", "POST /captures")
    assert "needs a token with the scope 'steer'" in found[0].detail
    assert found[1].who == "127.0.0.1:123"
    assert found[4].action == "DELETE /models/{model}"


def test_a_scope_that_only_the_request_shows_to_lack_is_audited_too(app, service, tokens):
    ada = {"Authorization": f"Bearer {tokens.make('ada', ('read', 'steer'))}"}
    send(app, "POST /captures", ada, json={"armed_by": "Ada"})
    send(app, "DELETE /lease?force=true", ada)
    found = [(a.who[:3], a.action, a.detail[-12:]) for a in lines(service)]
    assert found == [
        ("ada", "POST /captures", " scope 'arm'"),
        ("ada", "DELETE /lease", "cope 'admin'"),
    ]


def test_a_blackout_that_is_refused_is_in_the_audit_log(app, service):
    for headers in ({}, {"Hairstage-Blackout": "x.y"}, {**MINE, "Origin": "http://evil.example"}):
        assert send(app, DARK, headers).status_code in (401, 403)
    found = [(a.action, a.result, a.detail.partition(":")[0]) for a in lines(service)]
    assert found == [
        ("blackout", "refused", "unauthorized"),
        ("blackout", "refused", "unauthorized"),
        ("blackout", "refused", "foreign-origin"),
    ]


def test_a_flood_of_refusals_is_a_few_lines_and_a_count(app, service, tokens):
    ada, bob = (tokens.make(name, ("read",)) for name in ("ada", "bob"))
    for _ in range(300):
        send(app, "POST /captures", {"Authorization": f"Bearer {ada}"})
    send(app, "POST /captures", {"Authorization": f"Bearer {bob}"})
    send(app, DARK, {})  # nobody else's are lost in it
    assert [a.who.partition(" ")[0] for a in lines(service)] == ["ada"] * 5 + [
        "bob",
        "127.0.0.1:123",
    ]
    service.close()
    last = lines(service)[-1]
    assert (last.who, last.action, last.result) == ("ada (127.0.0.1)", "POST /captures", "refused")
    assert last.detail.startswith("forbidden: 295 more ")


def test_counted_refusals_are_recorded_soon_after(tmp_path, monkeypatch):
    monkeypatch.setattr(refusals, "EVERY_S", 0.05)
    audit = AuditLog(tmp_path / "audit.jsonl")
    counted = Refusals(audit)
    for port in range(20):
        counted.note("", f"10.0.0.1:{port}", "login", "/login", "unauthorized", "no such token")
    until(lambda: "15 more" in (audit.latest(1) or [SimpleNamespace(detail="")])[0].detail)
    assert len(audit.latest(100)) == 6
    counted.close()
    assert len(audit.latest(100)) == 6


def test_refusals_from_everywhere_are_counted_together_in_the_end(tmp_path):
    audit = AuditLog(tmp_path / "audit.jsonl")
    counted = Refusals(audit)
    for address in range(1000):
        counted.note("", f"10.0.{address}.1:1", "login", "/login", "unauthorized", "x" * 1000)
    counted.close()
    audit.flush(60.0)
    found = audit.latest(10_000)
    assert len(found) == refusals.MOST_CAUSES + refusals.FIRST + 1
    left = 1000 - refusals.MOST_CAUSES - refusals.FIRST
    assert (found[-1].who, found[-1].detail.split()[1]) == ("other addresses", f"{left}")


def test_wrong_logins_make_their_address_wait_and_no_other(app, service, tokens, clock):
    right = {"token": tokens.make("ada", ("read",))}
    first = send(app, "POST /login", {}, json=right)
    assert wrong(app, 5).status_code == 401
    response = send(app, "POST /login", {}, json=right)
    refused(response, "too-many-logins", 429)
    assert 1 <= int(response.headers["retry-after"]) <= 2
    assert send(app, "POST /login", {}, json=right, host="10.0.0.2").status_code == 200
    assert send(app, DARK, {}).status_code == 401
    for headers in (MINE, {"Hairstage-Blackout": first.json()["blackout"]}):
        assert send(app, DARK, headers).json()["state"] == "dark"
    once = {"Hairstage-Blackout": first.json()["blackout"]}  # a page that has logged in before
    assert send(app, "POST /login", once, json=right).status_code == 200
    waits = []
    for _ in range(8):
        clock.now += waits[-1] if waits else 2
        assert wrong(app).status_code == 401  # looked at again
        waits.append(int(wrong(app).headers["retry-after"]))
    assert waits == sorted(waits)
    assert waits[0] < waits[4]
    assert waits[-1] <= attempts.LONGEST_S + 1
    clock.now += attempts.LONGEST_S + 1
    assert send(app, "POST /login", {}, json=right).status_code == 200
    kinds = {a.detail.partition(":")[0] for a in lines(service) if a.result == "refused"}
    assert kinds == {"unauthorized", "too-many-logins"}


def test_a_page_that_guesses_waits_by_itself(app, tokens):
    right = tokens.make("ada", ("read",))
    page = send(app, "POST /login", {}, json={"token": right}).json()["blackout"]
    for _ in range(5):
        send(app, "POST /login", {"Hairstage-Blackout": page}, json={"token": "x"})
    again = send(app, "POST /login", {"Hairstage-Blackout": page}, json={"token": right})
    refused(again, "too-many-logins", 429)
    assert send(app, "POST /login", {}, json={"token": right}).status_code == 200


@pytest.fixture
def hung(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The disk of the audit log takes no line until the test ends."""
    free, real = threading.Event(), AuditLog._append

    def append(log: AuditLog, line: str) -> None:
        free.wait()
        real(log, line)

    monkeypatch.setattr(AuditLog, "_append", append)
    yield
    free.set()


def test_a_disk_that_takes_no_line_keeps_nobody_from_a_blackout(
    rig_file, tokens, tmp_path, world, hung, monkeypatch
):
    """Neither refusals nor logins, nor a blackout's own line: it is dark, and says so."""
    monkeypatch.setattr(control, "RECORDED_S", 0.05)
    with serving(rig_file, tmp_path / "root", Access(tokens)) as http:
        for _ in range(100):
            assert http.post("/login", json={"token": "guessed"}, timeout=10).status_code in (
                401,
                429,
            )
            assert http.post("/captures", json={}, timeout=10).status_code == 401
        for _ in range(3):
            world.lit = {5}
            response = http.post("/devices/blackout", headers=MINE).json()
            assert (response["state"], world.lit) == ("dark", set())
        for _ in range(70):  # more than there are threads for what must be answered
            assert http.post("/captures/x/abort", headers=MINE).status_code == 404
        assert http.post("/devices/blackout", headers=MINE).json()["state"] == "dark"


def test_each_blackout_is_made_while_the_audit_log_hangs(tmp_path, hung, monkeypatch):
    monkeypatch.setattr(control, "RECORDED_S", 0.05)
    monkeypatch.setattr(control, "MOST_BLACKOUTS", 1)
    made: list[int] = []
    darkening = Control(AuditLog(tmp_path / "audit.jsonl"), Leases(tmp_path / "lease.json"))

    def work() -> dict[str, Any]:
        made.append(1)
        return {"state": "dark", "detail": f"number {len(made)}"}

    said = [darkening.blackout(Caller("here"), work)["detail"] for _ in range(3)]
    assert said == ["number 1", "number 2", "number 3"]


def test_a_client_does_not_write_its_own_address(rig_file, tokens, tmp_path):
    """It could else have another address wait, and its own never."""
    with serving(rig_file, tmp_path / "root", Access(tokens)) as http:
        headers = {"X-Forwarded-For": "10.9.9.9", "X-Forwarded-Proto": "https"}
        response = http.post("/login", json={"token": "mine"}, headers=headers)
        assert "Secure" not in response.headers["set-cookie"]
        who = http.get("/audit", headers=MINE).json()[-1]["who"]
        assert "127.0.0.1" in who


def test_every_route_that_changes_anything_is_audited(app, service):
    """So is a login; what only looks is not."""
    looks = ("/plans:validate", "/view/models", "/logout")
    changes = [
        (method, path)
        for method, path in routes_of(app)
        if method != "GET" and not (method == "POST" and path.startswith(looks))
    ]
    for method, path in changes:
        send(app, f"{method} {path}", {"Authorization": "Bearer x"}, json={"token": "x"})
    names = {"/devices/blackout": "blackout", "/login": "login"}
    expected = {names.get(path, f"{method} {path}") for method, path in changes}
    assert {a.action for a in lines(service)} == expected
