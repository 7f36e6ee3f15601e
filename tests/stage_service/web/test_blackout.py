"""Blackout by its button and by F9 in every state of the page, checked at the simulated bank."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from browsing import Pages, says
from filming import BRIGHTEST, SIZES
from simulating import simulating, small_rig_text
from waiting import machine_slack, until

from simulators.peers.devices import DEVICES_FILE
from simulators.peers.faults import Fault
from stage_service.records.tokens import Tokens, own_token

LIT = {
    "projectors": [],
    "sentinels": False,
    "stepping": "software",
    "exposure": {"olat": 0.1},
    "rate_hz": 4,
}
LIGHTS = 300
"""A capture of so many, of which one is lit nearly half of the time, takes over a minute: it does
not end before it is darkened, however busy the machine is."""
SHOWN = SIZES if "HAIRSTAGE_FILM" in os.environ else ("desk",)
EXPECTED_COMPLAINTS = ("401", "503", "ERR_")  # Chromium's own, of requests that a state refuses
NOT_DARKENED = "Log in again. The stage was NOT darkened: press the wired emergency stop."


class Desk:
    """A stage, the process of its service, and pages of its console."""

    def __init__(self, folder: Path, browser: Any, rig_file: Any, world: Any) -> None:
        self.root, self.world, self._browser = folder / "root", world, browser
        self._rig, self.watchdog_s = rig_file.path, rig_file.devices.watchdog_s
        self._opened: list[Pages] = []
        self.lease: dict[str, str] = {}
        self.tokens = Tokens(self.root / "tokens.json", own_token())
        self.port = 0
        self.start()
        self.tokens.make("reader", ("read",))

    def start(self) -> None:
        """Start the service, at the same port as before."""
        devices = self._rig.with_suffix("") / DEVICES_FILE
        command = [
            sys.executable,
            "-m",
            "stage_service.cli",
            "serve",
            "--json",
            "--port",
            self.port,
        ]
        command += ["--rig", self._rig, "--devices", devices, "--root", self.root]
        self.process = subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.url = json.loads(self.process.stdout.readline())["url"]
        self.port = httpx.URL(self.url).port or 0
        headers = {"Authorization": f"Bearer {own_token()}"}
        self.http = httpx.Client(base_url=self.url, headers=headers, timeout=60, trust_env=False)

    def kill(self) -> None:
        """End the service at once."""
        self.http.close()
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()

    @property
    def lit(self) -> bool:
        """Whether a lamp is on, by the bank itself."""
        return bool(self.world.lamps.power().any())

    def light(self) -> str:
        """Begin a capture, and wait for one of its lamps; returns its id.

        A blackout that a page sent while the service was away may still end one before that.
        """
        while True:
            until(lambda: self.http.get("/health").json()["capture"] is None)
            response = self.http.post("/captures", json={"plan": LIT}, headers=self.lease)
            assert response.status_code == 202, response.text
            path = f"/captures/{response.json()['id']}"
            until(lambda path=path: self.lit or self.http.get(path).json().get("outcome"))
            if self.lit:
                return str(response.json()["id"])

    def outcome(self, capture: str) -> str:
        """How a capture that is about to end has ended."""
        return str(until(lambda: self.http.get(f"/captures/{capture}").json()["outcome"]))

    def pages(self) -> Pages:
        """A browser of its own."""
        self._opened.append(Pages(self._browser, self.url))
        return self._opened[-1]

    def page(self, token: str | None = None) -> Any:
        """A page that is logged in by this token, the operator's own by default."""
        return self.pages().open_as(token or own_token())

    def settle(self) -> None:
        """As it was: no capture, no lease, no page; says what pages complained of unexpectedly."""
        if self.process.poll() is not None:
            self.start()
        self.process.send_signal(signal.SIGCONT)
        self.http.post("/devices/blackout")
        self.http.delete("/lease?force=true")
        self.lease = {}
        for pages in self._opened:
            pages.close()
        messages = [text for pages in self._opened for text in pages.complaints]
        self._opened.clear()
        assert [x for x in messages if not any(y in x for y in EXPECTED_COMPLAINTS)] == []


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory, browser: Any) -> Iterator[Callable[..., Desk]]:
    """`stage(*faults)`: the desk of a stage with these faults, one for all states."""
    slack, desks = machine_slack(), {}
    rig = small_rig_text(slack, 3.0).replace("lights = 24", f"lights = {LIGHTS}")
    with simulating(tmp_path_factory.mktemp("desk"), small_rig_text(slack), slack) as start:

        def of(*faults: Fault) -> Desk:
            if faults not in desks:
                folder = tmp_path_factory.mktemp("service")
                desks[faults] = Desk(folder, browser, *start(*faults, rig=rig))
                assert len(desks[faults].http.get("/rig").json()["lights"]) == LIGHTS
            return desks[faults]

        yield of
        for desk in desks.values():
            desk.kill()


@pytest.fixture(params=["", pytest.param("filmed", marks=pytest.mark.slow)])
def film(request, film):
    """Takes no pictures in the fast tests, but where a test is filmed in any case."""
    if not request.param and "HAIRSTAGE_FILM" not in os.environ:
        film.take = lambda *_, **__: None
    return film


filmed = pytest.mark.parametrize("film", ["filmed"], indirect=True)


@pytest.fixture
def desk(stage: Callable[..., Desk]) -> Iterator[Desk]:
    yield stage()
    stage().settle()


def f9(page: Any) -> None:
    page.keyboard.press("F9")


def button(page: Any) -> None:
    page.click("button.blackout")


PRESSES = (f9, button)


def response_to(press: Callable[[Any], None], page: Any) -> Any:
    """The service's response to the blackout that this press sends."""
    with page.expect_response("**/devices/blackout") as found:
        press(page)
    return found.value


# Each state: brings a page into it while a lamp is lit, and returns the page.


def second_tab(desk: Desk) -> Any:
    pages = desk.pages()
    first, second = pages.open_as(own_token()), pages.open()
    desk.light()
    for page in (first, second):
        says(page, "Shooting")
    return second


def somebody_elses_lease(desk: Desk) -> Any:
    page = desk.page()
    lease = desk.http.post("/lease", json={"holder": "Eve", "seconds": 600}).json()
    desk.lease = {"Hairstage-Lease": lease["token"]}
    desk.light()
    page.wait_for_selector("text=Eve steers")
    return page


def read_only_token(desk: Desk) -> Any:
    desk.tokens.revoke("reader")
    page = desk.page(desk.tokens.make("reader", ("read",)))
    desk.light()
    says(page, "Shooting")
    assert page.query_selector("text=take") is None or not page.is_visible("text=take")
    return page


def events_refused(desk: Desk) -> Any:
    pages = desk.pages()
    detail = json.dumps({"detail": "256 listeners follow the events already"})
    refusal = {"status": 503, "body": detail, "content_type": "application/problem+json"}
    page = pages.open_as(
        own_token(), lambda page: page.route("**/events", lambda r: r.fulfill(**refusal))
    )
    desk.light()
    says(page, "Shooting")
    page.wait_for_selector(".alarm:has-text('The service refuses live events to this page')")
    return page


def login_ended(desk: Desk) -> Any:
    page = desk.page()
    desk.light()
    page.context.request.post(f"{desk.url}/logout")
    page.wait_for_selector(".alarm:has-text('Your login has ended')")
    return page


def token_revoked(desk: Desk) -> Any:
    page = desk.page(desk.tokens.make("bob", ("read", "steer")))
    desk.light()
    desk.tokens.revoke("bob")
    page.wait_for_selector(".alarm:has-text('Your login has ended')")
    return page


RESPONDING = {
    state.__name__: state
    for state in (
        second_tab,
        somebody_elses_lease,
        read_only_token,
        events_refused,
        login_ended,
        token_revoked,
    )
}


@pytest.mark.parametrize("state", RESPONDING)
def test_blackout_while_the_service_responds(state, desk, film):
    page = RESPONDING[state](desk)
    film.take(page, f"{state}_before", sizes=SHOWN, brightest=2 * BRIGHTEST)
    for press in PRESSES:
        if press is button:
            desk.light()
        press(page)
        page.wait_for_selector(
            "#notices:has-text('Dark, verified'), .alarm:has-text('Dark, verified')"
        )
        (last,) = desk.http.get("/captures?limit=1").json()
        assert desk.outcome(last["id"]) == "aborted"
        assert not desk.lit
    page.wait_for_selector("#top .state:text-is('dark'), #top .state:text-is('not logged in')")
    film.take(page, f"{state}_after", sizes=SHOWN, brightest=2 * BRIGHTEST)
    assert film.wrong == [], "\n".join(film.wrong)


@filmed
def test_a_page_that_was_never_logged_in_shows_that_it_cannot_darken(desk, film):
    page = desk.pages().open()
    page.wait_for_selector(".alarm:has-text('This page cannot darken the stage.')")
    capture = desk.light()
    for press in PRESSES:
        assert response_to(press, page).status == 401
        page.wait_for_selector(f".alarm:has-text({NOT_DARKENED!r})")
    assert desk.http.get(f"/captures/{capture}").json()["state"] == "running"
    film.take(page, "never_logged_in", sizes=SHOWN, brightest=2 * BRIGHTEST)
    page.fill("[name=token]", own_token())
    page.keyboard.press("Enter")
    assert desk.outcome(capture) == "aborted"
    page.wait_for_selector(f".alarm:has-text({NOT_DARKENED!r})", state="detached")
    assert not desk.lit
    assert film.wrong == [], "\n".join(film.wrong)


@filmed
def test_a_lamp_that_stays_lit_is_named_when_blackout_is_pressed(stage, film):
    desk = stage(Fault("lights", "stuck", 5))
    page = desk.page()
    desk.light()
    says(page, "UNSAFE")
    (lamp,) = desk.world.lamps.power().nonzero()[0]
    for press in PRESSES:
        assert response_to(press, page).json()["state"] == "unknown, unsafe"
        page.wait_for_selector(".notice:has-text('unknown, unsafe')")
        assert desk.lit
    assert f"light_{lamp:03d} was lit last" in page.text_content(".alarm.latch")
    assert page.text_content("circle.doubt title") == f"light_{lamp:03d}"
    assert "verified" not in page.text_content("body")
    for offered in ("Shoot what is missing", "New capture"):
        assert not page.is_visible(f"text={offered}")
    film.take(page, "unsafe", sizes=SHOWN, brightest=2 * BRIGHTEST)
    assert film.wrong == [], "\n".join(film.wrong)


def no_response(page: Any, desk: Desk) -> None:
    """The page claims nothing of now while nothing comes from the service."""
    page.wait_for_selector("h1:has-text('No response since')")
    page.wait_for_selector("circle.light.lit", state="detached")
    alarm = page.text_content(".alarm:has-text('No response from the service since')")
    assert "the light bank's watchdog switches the lamps off" in alarm
    assert f"{desk.watchdog_s:g} s after the service's last heartbeat" in alarm
    for claim in ("Dark, verified", "Shooting"):
        assert not page.is_visible(f"h1:has-text({claim!r})")
    assert "left" not in page.text_content("#top .detail")


def frozen_or_dead(desk: Desk) -> dict[Callable[[Any], None], Any]:
    """A page for each way to press, that shows a lit lamp."""
    pages = {press: desk.page() for press in PRESSES}
    desk.light()
    for page in pages.values():
        page.wait_for_selector("circle.light.lit")
    return pages


def press_without_response(desk: Desk, pages: dict[Callable[[Any], None], Any]) -> None:
    """The service has just stopped: the watchdog switches the lamps off; no page claims it."""
    until(lambda: not desk.lit)
    for press, page in pages.items():
        no_response(page, desk)
        press(page)
    for page in pages.values():
        alarm = page.wait_for_selector(".alarm:has-text('has had no response for')")
        assert "Press the wired emergency stop" in alarm.text_content()


@pytest.mark.parametrize("login", ["kept", pytest.param("ended", marks=pytest.mark.slow)])
def test_blackout_is_repeated_until_a_restarted_service_responds(login, desk, film):
    pages = frozen_or_dead(desk)
    desk.kill()
    press_without_response(desk, pages)
    if login == "kept":
        film.take(pages[button], "no_connection", sizes=SHOWN, brightest=2 * BRIGHTEST)
    else:
        (desk.root / "logouts.json").unlink()  # ends all logins, and no blackout right
    desk.start()
    done = "#notices" if login == "kept" else ".alarm"
    for page in pages.values():
        page.wait_for_selector(f"{done}:has-text('Dark, verified')")
        page.wait_for_selector(".alarm:has-text('has had no response for')", state="detached")
    actions = [a["action"] for a in desk.http.get("/audit").json()]
    assert actions[-1] == "blackout"
    if login == "ended":
        pages[button].wait_for_selector("form.login")
        film.take(pages[button], "login_lost_in_a_restart", sizes=SHOWN, brightest=2 * BRIGHTEST)
    for press, page in pages.items():  # open since before the restart
        capture = desk.light()
        press(page)
        assert desk.outcome(capture) == "aborted"
        assert not desk.lit
    if login == "kept":
        film.take(pages[button], "restarted", sizes=SHOWN, brightest=2 * BRIGHTEST)
    assert film.wrong == [], "\n".join(film.wrong)


def test_blackout_over_a_frozen_service_is_shown_without_a_response(desk, film):
    pages = frozen_or_dead(desk)
    desk.process.send_signal(signal.SIGSTOP)
    press_without_response(desk, pages)
    film.take(pages[f9], "frozen", sizes=SHOWN, brightest=2 * BRIGHTEST)
    desk.process.send_signal(signal.SIGCONT)
    for page in pages.values():
        page.wait_for_selector("#notices:has-text('Dark, verified'), #notices:has-text('Reported')")
        page.wait_for_selector(".alarm:has-text('No response from the service')", state="detached")
    assert not desk.lit
    assert film.wrong == [], "\n".join(film.wrong)
