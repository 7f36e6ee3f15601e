"""What one caller holds takes nothing from those who steer, and nobody's way to a blackout."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from typing import Any

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from serving import Client, serving
from waiting import until

from reconstruction import Model, Strands
from stage_service.api import bodies, connections, porch, throttle
from stage_service.api.admission import AT_ONCE, Admission
from stage_service.api.gate import Access
from stage_service.api.places import LIMITS, Kind, NoPlace, Owner, Places
from stage_service.api.porch import Verdict
from stage_service.api.throttle import Throttle, Throttled
from stage_service.records.tokens import Scope, Tokens

SCOPES: dict[str, tuple[Scope, ...]] = {
    "reader": ("read",),
    "jobber": ("read", "jobs"),
    "ada": ("read", "steer"),
    "bob": ("read", "steer"),
}
LONG = {"plan": {"projectors": []}}
HEAD = b"v 0 0 0\nv 0 1 0\nv 1 0 0\ng scalp\nf 1 2 3\n"


class Callers:
    """A service and its callers by name; each connection is one of its own."""

    def __init__(self, http: Client, tokens: dict[str, str], stack: ExitStack) -> None:
        self.http, self._tokens, self._stack = http, tokens, stack

    def send(self, name: str, what: str, **more: Any) -> httpx.Response:
        """The answer to a request like "GET /rig" by the token of that name ("": by none)."""
        method, path = what.split(" ")
        own = {"Authorization": f"Bearer {self._tokens[name]}"} if name else {}
        return httpx.request(
            method, self.http.base_url.join(path), headers=own, timeout=60, trust_env=False, **more
        )

    def open(self, name: str, what: str, more: str = "", *, received: int = 0) -> socket.socket:
        """A connection over which that request has gone, and which has read nothing."""
        url = self.http.base_url
        link = self._stack.enter_context(socket.socket())
        if received:
            link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, received)
        link.settimeout(60)
        link.connect((url.host, url.port))
        own = f"Authorization: Bearer {self._tokens[name]}\r\n" if name else ""
        link.sendall(f"{what} HTTP/1.1\r\nHost: {url.host}:{url.port}\r\n{own}{more}\r\n".encode())
        return link


def status(link: socket.socket) -> int:
    """Of the answer that begins there."""
    data = b""
    while len(data) < 12:
        data += link.recv(12 - len(data))
    return int(data[9:12])


def ended(link: socket.socket) -> bool:
    """Waits until the service has ended it."""
    try:
        while link.recv(1 << 20):
            pass
    except ConnectionResetError:
        pass
    return True


def assert_refused(response: httpx.Response, status: int, *words: str) -> None:
    """The problem names the limit, and when to try again."""
    problem = response.json()
    assert (response.status_code, problem["type"]) == (status, "/docs/errors.md#no-place"), problem
    assert int(response.headers["retry-after"]) > 0
    assert all(word in problem["detail"] for word in words), problem["detail"]


@pytest.fixture
def callers(rig_file, tmp_path) -> Iterator[Callers]:
    known = Tokens(tmp_path / "tokens.json")
    tokens = {name: known.make(name, scopes) for name, scopes in SCOPES.items()}
    with serving(rig_file, tmp_path / "root", Access(known)) as http, ExitStack() as stack:
        yield Callers(http, tokens, stack)


@pytest.fixture
def limit(monkeypatch) -> Callable[..., None]:
    """`limit(kind, each=2)` changes one limit."""

    def change(kind: Kind, **more: float) -> None:
        monkeypatch.setitem(LIMITS, kind, replace(LIMITS[kind], **more))

    return change


@contextmanager
def shooting(callers: Callers, world: Any) -> Iterator[str]:
    """The id of a capture that is being shot until the end of the block."""
    with world.held():
        capture: str = callers.send("ada", "POST /captures", json=LONG).json()["id"]
        until(lambda: callers.http.service.running == capture)
        yield capture
        callers.send("ada", f"POST /captures/{capture}/abort")
    until(lambda: callers.http.service.running is None)


def assert_darkened(callers: Callers, world: Any, name: str) -> None:
    """A blackout by that token is answered, and the lamps are off."""
    world.lit, world.show = {5}, "ON 65535"
    response = callers.send(name, "POST /devices/blackout")
    assert (response.status_code, response.json()["state"]) == (200, "dark")
    assert (world.lit, world.show) == (set(), "OFF")


@pytest.mark.parametrize("kind", LIMITS)
def test_some_places_of_each_kind_are_out_of_reach(kind):
    """Of all who may not steer together with one that may: for another that may."""
    limit = LIMITS[kind]
    assert limit.each <= limit.others
    assert limit.others + limit.steering < limit.all


@given(st.lists(st.tuples(st.sampled_from("abcXY"), st.booleans()), max_size=400))
def test_others_never_have_what_is_kept(steps):
    """Whatever is taken and given back; capitals may steer."""
    found = Places()
    owners = {name: Owner(name, steers=name.isupper()) for name in "abcXYZ"}
    limit = LIMITS["streams"]
    for name, take in steps * 3:
        owner = owners[name]
        if take:
            with suppress(NoPlace):
                found.take("streams", owner)
        elif found.held("streams", owner):
            found.leave("streams", owner)
        others = sum(found.held("streams", owners[name]) for name in "abc")
        assert others <= limit.others
        assert all(found.held("streams", owners[name]) <= limit.each for name in "abc")
        assert all(found.held("streams", owners[name]) <= limit.steering for name in "XY")
        assert found.held("streams") <= limit.all


def test_a_place_that_is_given_back_goes_to_who_steers_first(limit):
    """Then to who has fewest; who has given up waiting gets none, and keeps none."""
    limit("requests", all=3, others=2, each=2, steering=3)

    async def run() -> list[str]:
        found, order = Places(), list[str]()
        reader, jobber, ada = Owner("reader"), Owner("jobber"), Owner("ada", steers=True)
        for owner in (reader, reader, ada):
            found.take("requests", owner)

        async def wait(owner: Owner) -> None:
            await found.wait("requests", owner)
            order.append(owner.name)

        tasks = [asyncio.create_task(wait(owner)) for owner in (reader, reader, jobber, ada)]
        await asyncio.sleep(0)
        tasks[0].cancel()
        await asyncio.sleep(0)
        for owner in (reader, ada, reader):
            found.leave("requests", owner)
            await asyncio.sleep(0)
            await asyncio.sleep(0)
        await asyncio.gather(*tasks[1:])
        assert found.held("requests") == 3
        return order

    assert asyncio.run(run()) == ["ada", "jobber", "reader"]


def test_while_a_capture_is_shot_work_of_others_is_done_one_piece_after_the_other(monkeypatch):
    monkeypatch.setattr(throttle, "WAIT_S", 0.01)
    monkeypatch.setattr(throttle, "SHARE", 1e-6)
    reader = Owner("reader")

    async def run() -> None:
        running = [True]
        found = Throttle(lambda: running[0])
        first = await found.turn(reader)
        with pytest.raises(Throttled, match="a capture is running"):
            await found.turn(Owner("another"))
        first.end()
        first.end()  # once
        # What it took is rested for, a million times as long.
        with pytest.raises(Throttled):
            await found.turn(reader)
        running[0] = False
        (await found.turn(reader)).end()

    asyncio.run(run())


def test_while_a_capture_is_shot_a_token_that_may_steer_has_a_credit(monkeypatch):
    """32 connections of one delayed a blackout by 1 s, and a capture took four times as long."""
    monkeypatch.setattr(throttle, "WAIT_S", 0.01)
    monkeypatch.setattr(throttle, "OVERHEAD_S", throttle.CREDIT_S / 3.5)
    monkeypatch.setattr(throttle, "STEERING_SHARE", 1e-3)
    ada = Owner("ada", steers=True)

    async def run() -> None:
        found = Throttle(lambda: True)
        for _ in range(2):
            both = [await found.turn(ada), await found.turn(ada)]
            with pytest.raises(Throttled):
                await found.turn(ada)
            for turn in both:
                turn.end()
        with pytest.raises(Throttled):
            await found.turn(ada)
        (await found.turn(Owner("eve", steers=True))).end()

    asyncio.run(run())


def test_streams_of_a_token_leave_the_console_its_own(callers):
    """256 of one token took all (F7)."""
    each = LIMITS["streams"].each
    held = [callers.open("reader", "GET /events") for _ in range(each)]
    assert {status(link) for link in held} == {200}
    refused = callers.send("reader", "GET /events")
    assert_refused(refused, 429, "token 'reader'", f"has {each} of", "event streams: close one")
    own = callers.open("ada", "GET /events")
    assert status(own) == 200
    callers.http.service.events.publish("test", {})
    lines = own.makefile("rb")
    assert any(line.startswith(b"event: test") for line in lines)
    held[0].close()
    until(lambda: status(callers.open("reader", "GET /events")) == 200, pause=0.05)


def test_responses_that_no_client_reads_are_aborted(callers, world, monkeypatch):
    """515 archives that nobody reads took every place until they were closed (F5)."""
    monkeypatch.setattr(connections, "STALL_S", 0.1)
    folder = callers.http.service.root / "models" / "large"
    Model(folder).create().write_strands(Strands.from_list([[[0, 0, 0], [0, 0, 1]]], radius=1e-4))
    (folder / "large.bin").write_bytes(bytes(8 << 20))
    tar = "GET /models/large/archive.tar"
    held = [callers.open("reader", tar, received=2048) for _ in range(LIMITS["downloads"].each)]
    assert {status(link) for link in held} == {200}
    refused = callers.send("reader", tar)
    assert_refused(refused, 429, "token 'reader' has 4 of", "read them to their end")
    assert len(callers.send("ada", tar).content) > 8 << 20
    assert_darkened(callers, world, "ada")
    assert_darkened(callers, world, "reader")
    assert all(ended(link) for link in held)
    until(lambda: callers.send("reader", "HEAD /models/large/archive.tar").is_success)


def test_a_slow_upload_keeps_nobody_else_waiting(callers, limit, monkeypatch):
    """Four of them kept everybody's for 240 s (F9); and they are ended."""
    limit("uploads", wait_s=0.1)
    put, more = "PUT /uploads/a/head.obj", "Content-Length: 1000000\r\n"
    assert callers.send("reader", put, content=HEAD).status_code == 403
    for _ in range(4):
        assert status(callers.open("reader", put, more)) == 403
    slow = [callers.open("bob", put, more) for _ in range(LIMITS["uploads"].steering)]
    own_service = callers.http.service
    until(lambda: places_of(callers).held("uploads", Owner("bob", steers=True)) == 2)
    assert_refused(callers.send("bob", put, content=HEAD), 429, "token 'bob' has 2 of")
    assert callers.send("ada", put, content=HEAD).status_code == 200
    assert own_service.storage.uploads()
    monkeypatch.setattr(bodies, "GRACE_S", 0.1)
    late = callers.open("ada", put, more)
    late.sendall(HEAD)
    assert status(late) == 408
    assert len(slow) == 2


def places_of(callers: Callers) -> Places:
    """Who has how much; read from another thread than its own."""
    found: Places = callers.http.app.state.places
    return found


def test_without_places_a_token_may_still_darken(callers, world, limit, monkeypatch):
    """And see the way there; all else is refused, late, with the reason."""
    monkeypatch.setattr(porch, "HELD_S", 0.1)
    limit("connections", each=2)
    held = [callers.open("reader", "GET /events") for _ in range(2)]
    assert {status(link) for link in held} == {200}
    refused = callers.send("reader", "GET /rig")
    assert_refused(refused, 429, "token 'reader' has 2 of at most 2 connections")
    assert refused.headers["content-security-policy"].startswith("sandbox")
    assert_darkened(callers, world, "reader")
    for path in ("/", "/health", "/login"):
        response = callers.send("reader", f"GET {path}")
        assert (response.status_code, response.headers["connection"]) == (200, "close"), path
    assert callers.send("ada", "GET /rig").status_code == 200


def test_silent_connections_keep_nobody_out(callers, world, monkeypatch):
    monkeypatch.setattr(porch, "HEADER_S", 1.0)
    url = callers.http.base_url
    silent = [socket.create_connection((url.host, url.port), 60) for _ in range(300)]
    for link in silent[::2]:
        link.sendall(b"POST /devices/blackout HTTP/1.1\r\nX: ")
    assert_darkened(callers, world, "ada")
    assert_darkened(callers, world, "reader")
    assert all(ended(link) for link in silent)
    for link in silent:
        link.close()


def test_while_a_capture_is_shot_others_wait_and_who_steers_does_not(callers, world, monkeypatch):
    monkeypatch.setattr(throttle, "WAIT_S", 0.2)
    monkeypatch.setattr(throttle, "SHARE", 1e-6)  # after the first, none has a turn
    with shooting(callers, world) as capture:
        assert callers.send("reader", "GET /rig").status_code in (200, 503)
        for name, what in (
            ("reader", "GET /audit"),
            ("jobber", "GET /captures"),
            ("reader", "POST /captures/another/abort"),
            ("", "GET /rig"),
        ):
            assert_refused(callers.send(name, what), 503, "a capture is running")
        for what in ("GET /rig", "GET /captures", f"GET /captures/{capture}/steps"):
            assert callers.send("ada", what).status_code == 200
        assert callers.send("reader", f"POST /captures/{capture}/abort").status_code == 200
    assert callers.send("reader", "GET /rig").status_code == 200
    assert_darkened(callers, world, "reader")


def test_while_a_capture_is_shot_models_are_shown_to_who_steers_alone(callers, world):
    """Eight viewers slowed it by half (F16)."""
    folder = callers.http.service.root / "models" / "m"
    Model(folder).create().write_strands(Strands.from_list([[[0, 0, 0], [0, 0, 1]]], radius=1e-4))
    assert callers.send("reader", "GET /view/models/m").json()["name"] == "m"
    with shooting(callers, world):
        for what in ("GET /view/models/m", "POST /view/models/m/indirect/view"):
            assert_refused(callers.send("reader", what), 503, "a capture is running")
        assert callers.send("ada", "GET /view/models/m").json()["name"] == "m"


def test_large_bodies_are_refused_and_errors_are_short(callers):
    large = json.dumps({"lights": ["light_001"] * 20_000}).encode()
    assert callers.send("reader", "POST /plans:validate", content=large).status_code == 413
    wrong = json.dumps({"lights": [[]] * 4000}).encode()
    reported = callers.send("ada", "POST /plans:validate", content=wrong).json()
    assert len(reported["errors"]) <= 20
    assert len(reported["detail"]) < 4000
    many = json.dumps({"lights": [[]] * 10_001}).encode()
    reported = callers.send("ada", "POST /plans:validate", content=many).json()
    assert reported["detail"].startswith("the body has 10,001 values")


def test_a_token_s_own_connections_that_wait_make_room_for_its_next(callers, limit):
    limit("connections", each=3)
    held = [callers.open("reader", "GET /health") for _ in range(3)]
    assert {status(link) for link in held} == {200}
    fourth = callers.open("reader", "GET /health")
    assert status(fourth) == 200


def test_a_flood_of_those_who_steer_waits_in_turn_but_for_blackouts(tmp_path: Any) -> None:
    tokens = Tokens(tmp_path / "tokens.json")
    known = {name: tokens.make(name, ("read", "steer")) for name in ("ada", "bob")}
    hall = connections.Hall(Places())
    admission = Admission(Access(tokens), hall, lambda: None)

    def at_once(what: str, name: str) -> bool:
        own = f"Authorization: Bearer {known[name]}\r\n" if name else ""
        head = f"{what} HTTP/1.1\r\nHost: localhost\r\n{own}\r\n"
        return admission.judge(head.encode(), "127.0.0.1").at_once

    flood = [at_once("GET /captures/a/archive.tar", "ada") for _ in range(1000)]
    assert all(flood[: int(AT_ONCE)])
    assert sum(flood) < 3 * AT_ONCE  # and some while the others were judged
    assert at_once("POST /devices/blackout", "ada")
    assert at_once("GET /health", "bob")
    assert not at_once("GET /health", "")


def test_a_crowd_does_not_keep_out_who_steers_and_has_a_place(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    tokens, places = Tokens(tmp_path / "tokens.json"), Places()
    known = {who: tokens.make(who, ("read", who)) for who in ("steer", "jobs")}
    admission = Admission(Access(tokens), connections.Hall(places), lambda: None)
    monkeypatch.setattr(connections.Hall, "crowded", True)

    def judged(who: str) -> Verdict:
        own = f"Authorization: Bearer {known[who]}"
        head = f"GET /captures HTTP/1.1\r\nHost: localhost\r\n{own}\r\n\r\n"
        return admission.judge(head.encode(), "127.0.0.1")

    assert judged("steer").at_once
    assert not judged("jobs").at_once
    assert not judged("jobs").may()
    owner = Owner("steer", steers=True)
    while places.lacks("connections", owner) is None:
        places.take("connections", owner)
    assert not judged("steer").at_once
