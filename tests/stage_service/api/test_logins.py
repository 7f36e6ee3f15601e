"""Logins that outlast the service, and the right to a blackout that outlasts them."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from disks import on_small_disk, require_small_disk
from serving import refused, routes_of, send
from waiting import until

from stage_service.api.app import create_app
from stage_service.api.gate import Access
from stage_service.cli import main
from stage_service.cli.stage import processes
from stage_service.cli.support.commands import Output
from stage_service.config import RigFile
from stage_service.records import logins
from stage_service.records.logins import Logins
from stage_service.records.tokens import SCOPES, Tokens
from stage_service.service import Service

DARK = "POST /devices/blackout"
NOT_DARK = "The stage was NOT darkened: press the wired emergency stop."
MINE = {"Authorization": "Bearer mine"}
Call = Callable[..., httpx.Response]


@pytest.fixture
def tokens(tmp_path: Path) -> Tokens:
    return Tokens(tmp_path / "root" / "tokens.json", own="mine")


@pytest.fixture
def started(
    rig_file: RigFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Any]:
    """`with started() as ask`: a service of the root folder, as `hairstage serve` starts it."""
    (tmp_path / "token").write_text("mine")
    monkeypatch.setenv("HAIRSTAGE_TOKEN_FILE", str(tmp_path / "token"))
    args = argparse.Namespace(no_auth=False, root=tmp_path / "root", root_path="")

    @contextmanager
    def start() -> Iterator[Call]:
        service = Service(rig_file, tmp_path / "root")
        service.take_stage()
        app = create_app(service, processes._access(args, set(), Output(as_json=False)))
        try:
            yield lambda what, headers=(), **more: send(app, what, dict(headers), **more)
        finally:
            service.close()

    return start


@pytest.fixture
def call(started: Callable[..., Any]) -> Iterator[Call]:
    with started() as call:
        yield call


def log_in(call: Call, token: str = "mine", **more: Any) -> tuple[dict[str, str], dict[str, str]]:
    """The headers with the cookie of a login, and with the blackout right that came with it."""
    response = call("POST /login", json={"token": token}, **more)
    assert response.status_code == 200, response.text
    cookie = response.headers["set-cookie"].partition(";")[0]
    return {"Cookie": cookie}, {"Hairstage-Blackout": response.json()["blackout"]}


def is_dark(response: httpx.Response) -> bool:
    return bool(response.json().get("state") == "dark")


def test_a_login_and_a_blackout_right_outlast_the_service(started, tokens, tmp_path, world):
    ada = tokens.make("ada", ("read", "steer"))
    with started() as call:
        cookie, right = log_in(call, ada)
    assert (tmp_path / "root" / "login.key").stat().st_mode & 0o777 == 0o600
    with started() as call:
        assert call("GET /login", cookie).json()["name"] == "ada"
        for headers in (cookie, right):
            world.lit = {5}
            assert (is_dark(call(DARK, headers)), world.lit) == (True, set())
        callers = [a["who"].partition(" (")[0] for a in call("GET /audit", MINE).json()]
        assert callers[-2:] == ["ada", "ada, blackout right"]
        tokens.revoke("ada")
        refused(call("GET /login", cookie), "unauthorized", 401)


def test_no_number_of_logins_ends_another(rig_file, tokens, tmp_path):
    """One thousand were kept, and the oldest forgotten, whoever they were of."""
    service = Service(rig_file, tmp_path / "root")
    reader = tokens.make("reader", ("read",))
    logins = Logins(tmp_path / "root")
    app = create_app(service, Access(tokens, logins=logins))
    try:
        cookie, _ = log_in(lambda what, **more: send(app, what, {}, **more))
        for _ in range(1001):
            logins.begin(reader, "127.0.0.1")
        assert is_dark(send(app, DARK, cookie))
    finally:
        service.close()


def test_a_right_opens_the_blackout_and_nothing_else(rig_file, tokens, tmp_path):
    service = Service(rig_file, tmp_path / "root")
    app = create_app(service, Access(tokens))

    def call(what: str, headers: Any = (), **more: Any) -> httpx.Response:
        return send(app, what, dict(headers), **more)

    _, right = log_in(call, tokens.make("ada", SCOPES))
    opened, public = (
        {
            (method, path)
            for method, path in routes_of(app)
            if call(f"{method} {path}", headers, json={}).status_code != 401
        }
        for headers in (right, {})
    )
    assert opened - public == {("POST", "/devices/blackout")}
    assert len(routes_of(app)) > 70
    for other in ("GET /devices/blackout", "PUT /devices/blackout", "POST /devices/blackout/"):
        refused(call(other, right), "unauthorized", 401)
    refused(call("GET /captures?x=/devices/blackout", right), "unauthorized", 401)
    service.close()


def test_a_right_outlasts_logout_revocation_and_whatever_else_is_sent(call, tokens, monkeypatch):
    cookie, right = log_in(call, tokens.make("ada", ("read",)))
    assert call("POST /logout", cookie).json()["blackout"] == right["Hairstage-Blackout"]
    tokens.revoke("ada")
    later = SimpleNamespace(time_ns=lambda: 2 * 10**18)
    monkeypatch.setattr(logins, "time", later)
    for more in ({}, cookie, {"Authorization": "Bearer unknown"}, {"Authorization": "Basic x"}):
        assert is_dark(call(DARK, {**more, **right})), more


def test_a_right_is_no_login_and_a_login_no_right(call, tokens):
    cookie, right = log_in(call, tokens.make("ada", SCOPES))
    name, _, login = cookie["Cookie"].partition("=")
    text = right["Hairstage-Blackout"]
    refused(call("GET /login", {"Cookie": f"{name}={text}"}), "unauthorized", 401)
    refused(call("GET /login", {"Authorization": f"Bearer {text}"}), "unauthorized", 401)
    other = Logins().blackout_right("ada")  # of another root
    payload, _, mac = text.partition(".")
    refused(call(DARK, {"Hairstage-Blackout": login}), "unauthorized", 401)
    forged = (other, "", ".", "x", "ä", payload, f"{payload}.", f"{payload}.{mac}x")
    for wrong in (*forged, f"{payload[:-1]}.{mac}", f"{payload}x.{mac}", f"{text}.{mac}", mac):
        refused(call(DARK, {"Hairstage-Blackout": wrong.encode()}), "unauthorized", 401)
        refused(call("GET /login", {"Cookie": f"{name}={wrong}".encode()}), "unauthorized", 401)


def test_a_login_is_bound_to_host_and_port(call):
    here = "http://localhost:8331"
    cookie, right = log_in(call, url=here)
    assert call("GET /login", cookie, url=here).json()["name"]
    held = cookie["Cookie"].partition("=")[2]
    for host, port in (("localhost", 8332), ("127.0.0.1", 8331)):
        there = {"Cookie": f"hairstage-{port}={held}"}
        refused(call("GET /login", there, url=f"http://{host}:{port}"), "unauthorized", 401)
        assert is_dark(call(DARK, right, url=f"http://{host}:{port}"))


def test_over_tls_a_cookie_of_the_plain_name_opens_nothing(call):
    """Another port of the host could have set it; a browser takes `__Host-` from no other."""
    tls = "https://localhost:8331"
    cookie, _ = log_in(call, url=tls)
    assert cookie["Cookie"].startswith("__Host-hairstage-8331=")
    assert call("GET /login", cookie, url=tls).json()["name"]
    plain = {"Cookie": cookie["Cookie"].removeprefix("__Host-")}
    refused(call("GET /login", plain, url=tls), "unauthorized", 401)


def test_cookies_that_somebody_else_has_set_hide_no_login(call, tokens):
    """A page of another port sets one of the name with a longer path: it comes first."""
    good = log_in(call)[0]["Cookie"]
    over = log_in(call, tokens.make("ada", ("read",)))[0]["Cookie"]
    tokens.revoke("ada")
    name = good.partition("=")[0]
    for first in (f"{name}=x", f"{name}=", over, "; ".join([f"{name}=x"] * 50), f"{over}; {over}"):
        assert is_dark(call(DARK, {"Cookie": f"{first}; {good}"})), first
        assert is_dark(call(DARK, {"Cookie": f"{good}; {first}"})), first


def test_a_logout_outlasts_the_service(started, tokens):
    ada = tokens.make("ada", ("read",))
    with started() as call:
        over, other = log_in(call, ada)[0], log_in(call, ada)[0]
        call("POST /logout", over)
    with started() as call:
        refused(call("GET /login", over), "unauthorized", 401)
        assert call("GET /login", other).status_code == 200
        actions = [
            (a["who"].partition(" ")[0], a["action"]) for a in call("GET /audit", MINE).json()
        ]
        assert actions == [("ada", "login"), ("ada", "login"), ("ada", "logout")]


def test_many_logouts_keep_the_file_small_and_end_no_login_of_another_token(tmp_path):
    held, place = Logins(tmp_path), "localhost:1"
    ada, bob = held.begin("ada", place), held.begin("bob", place)
    first = held.begin("bob", place)
    held.end([first], place)
    for _ in range(60):
        held.end([held.begin("bob", place)], place)
    again = Logins(tmp_path)
    assert len(again.tokens_of([ada], place)) == 1
    assert again.tokens_of([first, bob], place) == []  # the price of that many, for bob alone
    assert len(again.tokens_of([held.begin("bob", place)], place)) == 1
    assert (tmp_path / "logouts.json").stat().st_size < 4000


@pytest.mark.parametrize("damage", ["", "x" * 64, "ab" * 31, "ä", None, "pipe", "open"])
def test_a_damaged_key_opens_nothing_and_is_replaced(started, tmp_path, damage, world):
    with started() as call:
        cookie, right = log_in(call)
    key = tmp_path / "root" / "login.key"
    old = key.read_text()
    if damage == "open":
        key.chmod(0o644)
    else:
        key.unlink()
        if damage == "pipe":
            os.mkfifo(key)
        elif damage is not None:
            key.write_text(damage)
    with started() as call:
        refused(call("GET /login", cookie), "unauthorized", 401)
        world.lit = {5}
        assert NOT_DARK in refused(call(DARK, right), "unauthorized", 401)["detail"]
        assert world.lit == {5}
        cookie, right = log_in(call)
        assert (key.stat().st_mode & 0o777, key.read_text() == old) == (0o600, False)
    with started() as call:
        assert call("GET /login", cookie).status_code == 200
        assert is_dark(call(DARK, right))


@pytest.mark.parametrize("damage", ["", "{}", '{"epoch": 1}', None])
def test_all_logins_end_when_the_list_of_logouts_is_lost(started, tmp_path, damage):
    with started() as call:
        cookie, right = log_in(call)
    file = tmp_path / "root" / "logouts.json"
    file.unlink()
    if damage is not None:
        file.write_text(damage)
    with started() as call:
        refused(call("GET /login", cookie), "unauthorized", 401)
        assert is_dark(call(DARK, right))
        cookie, _ = log_in(call)
    with started() as call:
        assert call("GET /login", cookie).status_code == 200


SMALL = """
import os, subprocess, sys
from pathlib import Path
from stage_service.records.logins import Logins, NotStored

root, place, readonly = Path(sys.argv[1]), "localhost:1", sys.argv[2] == "readonly"
logins = Logins(root)
kept, over = logins.begin("ada", place), logins.begin("ada", place)
right = logins.blackout_right("ada")
if readonly:
    subprocess.run(["mount", "-o", "remount,ro", root], check=True)
else:
    with (root / "filler").open("wb", buffering=0) as filler:
        try:
            while filler.write(bytes(4096)):
                pass
        except OSError:
            pass
try:
    logins.end([over], place)
    print("logged out")
except NotStored:
    print("not stored")
new = logins.begin("ada", place)
print([len(logins.tokens_of([one], place)) for one in (kept, over, new)])
again = Logins(root)
print([len(again.tokens_of([one], place)) for one in (kept, over, new)])
print(again.blackout_by(right), len(again.tokens_of([again.begin("ada", place)], place)))
"""


LATE = """
import sys, time
from pathlib import Path
from stage_service.records.logins import Logins

root, place = Path(sys.argv[1]), "localhost:1"
with (root / "filler").open("wb", buffering=0) as filler:
    try:
        while filler.write(bytes(4096)):
            pass
    except OSError:
        pass
logins = Logins(root)
first, right = logins.begin("ada", place), logins.blackout_right("ada")
print(len(logins.tokens_of([first], place)), logins.blackout_by(right))
(root / "filler").unlink()
while not (root / "login.key").exists():
    logins.begin("ada", place)
    time.sleep(0.01)
print(Logins(root).blackout_by(right))
"""


def test_a_key_that_a_full_disk_did_not_take_is_stored_later(tmp_path):
    require_small_disk(tmp_path)
    done = on_small_disk(tmp_path, sys.executable, "-c", LATE, str(tmp_path))
    assert done.stdout.splitlines() == ["1 ada", "ada"], done.stderr


@pytest.mark.parametrize("disk", ["full", "readonly"])
def test_a_disk_that_takes_nothing_locks_nobody_out(tmp_path, disk):
    """Of a full one the file of logouts goes: no logout is forgotten by a restart. A read-only one
    cannot even do that, so whoever logs out reads it (and no service starts on it)."""
    require_small_disk(tmp_path)
    done = on_small_disk(tmp_path, sys.executable, "-c", SMALL, str(tmp_path), disk)
    expected = {
        "full": ["logged out", "[1, 0, 1]", "[0, 0, 0]", "ada 1"],
        "readonly": ["not stored", "[1, 0, 1]", "[1, 1, 1]", "ada 1"],
    }
    assert done.stdout.splitlines() == expected[disk], done.stderr


def test_a_logout_that_fails_to_reach_the_disk_reports_it(call, monkeypatch):
    def read_only(*_: Any, **__: Any) -> None:
        raise OSError(30, "Read-only file system")

    cookie, _ = log_in(call)
    monkeypatch.setattr(logins, "write_secret", read_only)
    monkeypatch.setattr(Path, "unlink", read_only)
    response = call("POST /logout", cookie)
    monkeypatch.undo()
    assert "revoke the token" in refused(response, "not-stored", 507)["detail"]
    assert "Max-Age=0" in response.headers["set-cookie"]
    refused(call("GET /login", cookie), "unauthorized", 401)


@pytest.mark.parametrize("days", [-1, 1])
def test_a_clock_that_is_set_ends_logins_and_no_right(call, monkeypatch, days):
    cookie, right = log_in(call)
    real = logins.time.time_ns
    clock = SimpleNamespace(time_ns=lambda: real() + days * 86400 * 10**9)
    monkeypatch.setattr(logins, "time", clock)
    refused(call("GET /login", cookie), "unauthorized", 401)
    assert is_dark(call(DARK, right))
    assert call("GET /login", log_in(call)[0]).status_code == 200


def test_a_command_ends_all_blackout_rights_at_once(call, tmp_path, capsys):
    cookie, right = log_in(call)
    assert is_dark(call(DARK, right))
    assert main(["token", "revoke-blackouts", "--root", str(tmp_path / "root")]) == 0
    assert "logins have ended" in capsys.readouterr().out
    until(lambda: call(DARK, right).status_code == 401)
    refused(call("GET /login", cookie), "unauthorized", 401)
    assert is_dark(call(DARK, log_in(call)[1]))
    assert is_dark(call(DARK, MINE))
    assert "blackout.revoke" in [a["action"] for a in call("GET /audit", MINE).json()]
    assert main(["token", "revoke-blackouts", "--root", str(tmp_path / "none")]) == 3


def test_a_key_that_goes_missing_while_the_service_runs_ends_nothing(call, tmp_path):
    cookie, right = log_in(call)
    (tmp_path / "root" / "login.key").unlink()
    for _ in range(3):
        assert call("GET /login", cookie).status_code == 200
        assert is_dark(call(DARK, right))


def test_a_blackout_that_is_refused_says_that_it_was_not_dark(call, world):
    _, right = log_in(call)
    world.lit = {5}
    for headers in ({}, {"Authorization": "Bearer x"}, {"Hairstage-Blackout": "x.y"}):
        detail = refused(call(DARK, headers), "unauthorized", 401)["detail"]
        assert detail == f"Log in again. {NOT_DARK}"
    for headers in (right, MINE):
        foreign = {**headers, "Origin": "http://evil.example"}
        assert NOT_DARK in refused(call(DARK, foreign), "foreign-origin", 403)["detail"]
        foreign = {**headers, "Host": "evil.example"}
        assert NOT_DARK in refused(call(DARK, foreign), "http", 421)["detail"]
    assert world.lit == {5}
    for body in (b"[", b'{"x": NaN}', b"x" * 2_000_000):  # a blackout has none, and reads none
        assert is_dark(call(DARK, {**right, "Content-Type": "application/json"}, content=body))
    assert world.lit == set()
