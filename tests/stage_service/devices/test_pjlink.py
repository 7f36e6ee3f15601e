"""PJLink over a real connection: the driver against the simulated projector, and its faults."""

from __future__ import annotations

import hashlib
import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest
from pjlink_projector import GREETING, PjLinkServer, SimulatedProjector

from stage_service.devices.errors import DeviceError, DeviceTimeout, DeviceUnreachable
from stage_service.devices.projectors.pjlink import Lamp, PjLinkProjector, Power, ProjectorBusy

PASSWORD = "JBMIAProjectorLink"


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def advance(self, seconds: float) -> None:
        self.now += seconds


class Rig:
    """A projector on a port, its clock, and the faults that strike at commands, once each."""

    def __init__(self, timeout_s: float) -> None:
        self.timeout_s = timeout_s
        self.clock = Clock()
        self.faults: list[tuple[str, str]] = []
        self._servers: list[PjLinkServer] = []

    def strikes(self, command: str) -> str | None:
        for fault in self.faults:
            if command.startswith(fault[0]):
                self.faults.remove(fault)
                return fault[1]
        return None

    def projector(
        self, needs: str = "", given: str = "", **options: float | bool
    ) -> PjLinkProjector:
        behind = SimulatedProjector(clock=self.clock, **options)  # type: ignore[arg-type]
        server = PjLinkServer(behind, needs, self.strikes)
        server.start()
        self._servers.append(server)
        return PjLinkProjector("front", "127.0.0.1", server.port, given, self.timeout_s)

    def stop(self) -> None:
        for server in self._servers:
            server.stop()


@pytest.fixture
def rig(slack: int) -> Iterator[Rig]:
    rig = Rig(timeout_s=0.4 * slack)
    yield rig
    rig.stop()


def peer(reply_with: Callable[[socket.socket], None]) -> tuple[int, threading.Thread]:
    """A server of one connection that says exactly what a test wants."""
    listening = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        with listening, listening.accept()[0] as link:
            reply_with(link)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    return int(listening.getsockname()[1]), thread


@pytest.mark.parametrize("password", ["", PASSWORD], ids=["open", "with password"])
def test_power_goes_through_warm_up_to_on_and_through_cooling_to_standby(
    rig: Rig, password: str
) -> None:
    projector = rig.projector(password, password, warm_up_s=60.0, cooling_s=90.0)
    assert projector.power() is Power.STANDBY
    projector.switch(True)
    assert projector.power() is Power.WARM_UP
    rig.clock.advance(60.0)
    assert projector.power() is Power.ON
    projector.switch(False)
    assert projector.power() is Power.COOLING
    rig.clock.advance(90.0)
    assert projector.power() is Power.STANDBY


@pytest.mark.parametrize("before", [b"\n", b"\n%1POWR ?\r", b"%1POWR ?\r\n\r\n"])
def test_echo_and_line_feeds_are_dropped_and_alone_are_no_reply(slack: int, before: bytes) -> None:
    for reply in (b"%1POWR=1\r\n", b""):
        held = threading.Event()

        def reply_with(link: socket.socket, reply=reply, held=held) -> None:
            link.sendall(b"PJLINK 0\r")
            assert link.recv(100) == b"%1POWR ?\r"
            for byte in before + reply:
                link.sendall(bytes((byte,)))
            held.wait(60)

        port, thread = peer(reply_with)
        projector = PjLinkProjector("front", "127.0.0.1", port, timeout_s=0.4 * slack)
        if reply:
            assert projector.power() is Power.ON
        else:
            with pytest.raises(DeviceTimeout, match=r"received (only an echo|'\\n'|nothing)"):
                projector.power()
        held.set()
        thread.join()


def test_a_projector_without_a_password_does_not_mind_one(rig: Rig) -> None:
    assert rig.projector("", PASSWORD).power() is Power.STANDBY


def test_lamp_hours_count_what_the_lamp_was_lit(rig: Rig) -> None:
    projector = rig.projector(hours=99_990.0, warm_up_s=0.0)
    assert projector.lamps() == (Lamp(99_990, False),)
    projector.switch(True)
    rig.clock.advance(9 * 3600.0)
    assert projector.lamps() == (Lamp(99_999, True),)


def test_a_projector_that_counts_no_lamps_has_none(rig: Rig) -> None:
    assert rig.projector(lamps=False).lamps() == ()


def test_the_digest_is_that_of_the_protocols_example() -> None:
    """PJLink Specifications 1.04: seed 498e4a67, password JBMIAProjectorLink."""
    request_bytes = b""

    def reply_with(link: socket.socket) -> None:
        nonlocal request_bytes
        link.sendall(b"PJLINK 1 498e4a67\r")
        request_bytes = link.recv(100)
        link.sendall(b"%1POWR=1\r")

    port, thread = peer(reply_with)
    projector = PjLinkProjector("front", "127.0.0.1", port, PASSWORD)
    assert projector.power() is Power.ON
    thread.join()
    assert request_bytes == b"5d8409bc1c3fa39749434aa3a5c38682%1POWR ?\r"
    assert request_bytes[:32] == hashlib.md5(b"498e4a67" + PASSWORD.encode()).hexdigest().encode()


@pytest.mark.parametrize(("given", "received"), [("", "a greeting"), ("wrong", "ERRA")])
def test_a_wrong_password_is_reported_without_its_text(rig: Rig, given: str, received: str) -> None:
    projector = rig.projector(PASSWORD, given)
    with pytest.raises(DeviceError, match=f"expected the right password.*{received}") as caught:
        projector.switch(True)
    assert "wrong" not in str(caught.value).replace("the password is wrong", "")
    assert PASSWORD not in repr(rig.projector(PASSWORD, PASSWORD))
    assert rig.projector(PASSWORD, PASSWORD).power() is Power.STANDBY


def test_standby_is_refused_during_warm_up_as_not_now(rig: Rig) -> None:
    projector = rig.projector()
    projector.switch(True)
    with pytest.raises(ProjectorBusy, match=r"switching the power off: .*ERR3.*try again later"):
        projector.switch(False)
    assert projector.power() is Power.WARM_UP


@pytest.mark.parametrize(
    ("fault", "kind", "text"),
    [
        ("silent", DeviceTimeout, r"expected a reply within {timeout} s, received nothing"),
        ("slow", DeviceTimeout, r"within {timeout} s, received '%1POWR=0'"),
        ("cut", DeviceUnreachable, r"received '%1PO', and the connection was closed"),
        ("garbage", DeviceError, r"x1b\[AWR=0"),
        ("busy", ProjectorBusy, "ERR3, not available now"),
        ("failure", DeviceError, "ERR4, a failure of the projector"),
    ],
)
def test_each_wire_fault_is_reported_and_does_not_affect_the_next_request(
    rig: Rig, fault: str, kind: type[DeviceError], text: str
) -> None:
    projector = rig.projector()
    rig.faults = [("%1POWR", fault)]
    begun = time.monotonic()
    with pytest.raises(DeviceError, match=text.format(timeout=f"{rig.timeout_s:g}")) as caught:
        projector.power()
    assert type(caught.value) is kind
    assert time.monotonic() - begun < 5 * rig.timeout_s
    assert f"projector front (PJLink 127.0.0.1:{projector.port}): reading" in str(caught.value)
    assert projector.power() is Power.STANDBY
    assert rig.faults == []


@pytest.mark.parametrize(
    ("fault", "kind", "text"),
    [
        ("silent", DeviceTimeout, "received nothing"),
        ("cut", DeviceUnreachable, "closed"),
        ("garbage", DeviceError, "a greeting like PJLINK 0"),
    ],
)
def test_a_broken_greeting_is_reported_and_nothing_is_switched(
    rig: Rig, fault: str, kind: type[DeviceError], text: str
) -> None:
    projector = rig.projector()
    rig.faults = [(GREETING, fault)]
    with pytest.raises(DeviceError, match=text) as caught:
        projector.switch(True)
    assert type(caught.value) is kind
    assert projector.power() is Power.STANDBY


def test_a_missing_projector_is_unreachable() -> None:
    with socket.create_server(("127.0.0.1", 0)) as gone:
        port = int(gone.getsockname()[1])
    with pytest.raises(DeviceUnreachable, match="PJLink is enabled"):
        PjLinkProjector("front", "127.0.0.1", port).power()


@pytest.mark.parametrize("wrong_reply", [b"%1POWR=7\r", b"%1LAMP=0\r", b"%2POWR=0\r", b"x" * 500])
def test_a_reply_outside_the_protocol_is_refused(wrong_reply: bytes) -> None:
    def reply_with(link: socket.socket) -> None:
        link.sendall(b"PJLINK 0\r")
        link.recv(100)
        link.sendall(wrong_reply)

    port, thread = peer(reply_with)
    with pytest.raises(DeviceError, match="expected %1POWR= and 0, 1, 2 or 3 within"):
        PjLinkProjector("front", "127.0.0.1", port).power()
    thread.join()


def test_lower_case_replies_are_read() -> None:
    request_bytes = b""

    def reply_with(link: socket.socket) -> None:
        nonlocal request_bytes
        link.sendall(b"pjlink 0\r")
        request_bytes = link.recv(100)
        link.sendall(b"%1powr=ok\r")

    port, thread = peer(reply_with)
    PjLinkProjector("front", "127.0.0.1", port).switch(True)
    thread.join()
    assert request_bytes == b"%1POWR 1\r"


def test_several_lamps_are_read() -> None:
    def reply_with(link: socket.socket) -> None:
        link.sendall(b"PJLINK 0\r")
        link.recv(100)
        link.sendall(b"%1LAMP=12 1 99999 0\r")

    port, thread = peer(reply_with)
    lamps = PjLinkProjector("front", "127.0.0.1", port).lamps()
    thread.join()
    assert lamps == (Lamp(12, True), Lamp(99_999, False))


def test_the_simulated_projector_replies_to_unknown_commands_with_errors() -> None:
    projector = SimulatedProjector()
    assert projector.reply("%1POWR 2") == "%1POWR=ERR2"
    assert projector.reply("%1INPT ?") == "%1INPT=ERR1"
