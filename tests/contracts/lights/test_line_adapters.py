"""Adapters between the service and the light bank: their echo, or their noise, is never an answer.

The truth is the bank's lamps; whatever a driver says of them has to agree.
"""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import pytest

from simulators.peers.faults import Fault
from simulators.peers.terminal import Adapter
from stage_service.device_config import ModbusTcpConfig
from stage_service.devices.errors import DeviceError, DeviceTimeout
from stage_service.devices.lights.modbus import ModbusLightBank

RTU, DMX, TCP = "simulated RTU", "simulated DMX", "simulated TCP"
ELSEWHERE = "simulated RTU, other registers"  # no noise there: its address, 1, is that of 01
ECHO, NUL_BEFORE, NUL_AFTER = Adapter(echo=True), Adapter(before=b"\0"), Adapter(after=b"\0")
HARMLESS = [ECHO, NUL_BEFORE, NUL_AFTER, Adapter(echo=True, before=b"\0\xff", after=b"\xff")]
NAMES = ["echo", "00 before", "00 after", "echo and noise"]


@pytest.mark.parametrize("adapter", HARMLESS, ids=NAMES)
@pytest.mark.parametrize("wire", [RTU, ELSEWHERE])
def test_an_echo_and_the_line_s_noise_are_dropped(bench, wire, adapter):
    one = bench(wire, connect=False)
    one.peer.stand_behind(adapter)
    one.lamps.select(7)
    one.driver.off()  # the first that a service does, before it knows the line
    assert one.lit() == []
    one.driver.connect()
    for lamp in (5, 199):
        one.driver.select(lamp)
        assert one.lit() == [lamp]
        assert one.driver.status().lit == 1
        one.driver.heartbeat()
    one.driver.set_level(0.5)
    one.driver.all_on()
    assert len(one.lit()) == 200
    assert max(one.powers()) == pytest.approx(0.5, abs=1 / 255)
    one.driver.load_sequence([(i, 1.0) for i in range(70)])
    one.driver.off()
    assert one.lit() == []


def test_an_echo_without_a_bank_is_no_reply(bench):
    one = bench(RTU, Fault("lights", "hang", 0), connect=False)
    one.peer.stand_behind(ECHO)
    calls: list[Callable[[], object]] = [
        one.driver.off,
        one.driver.connect,
        lambda: one.driver.select(1),
        one.driver.heartbeat,
        one.driver.status,
        lambda: one.driver.claim(7, "left:1"),
        one.driver.off,
    ]
    for call in calls:
        with pytest.raises(DeviceTimeout) as error:
            call()
        assert "received only an echo" in str(error.value)
        assert f"The adapter on {one.link} echoes: switch its local echo off" in str(error.value)


@pytest.mark.parametrize("call", ["select", "off", "heartbeat", "set_watchdog", "claim"])
def test_a_bank_that_dies_behind_an_echo_has_accepted_nothing(bench, call):
    """Writes of one register, whose right answer is the request itself."""
    one = bench(RTU, Fault("lights", "hang", 1), connect=False, clock=lambda: 50.0)
    one.peer.stand_behind(ECHO)
    one.driver.connect()
    one.driver.select(5)
    one.pulses = 1
    arguments = {"select": (6,), "set_watchdog": (1.0,), "claim": (7, "left:1")}.get(call, ())
    with pytest.raises(DeviceTimeout, match="received only an echo"):
        getattr(one.driver, call)(*arguments)
    assert one.lit() == [5]


def test_a_line_that_begins_to_echo_as_its_bank_dies_is_not_dark(bench):
    one = bench(RTU, Fault("lights", "hang", 1), clock=lambda: 50.0)  # its watchdog never trips
    one.driver.select(5)
    one.pulses = 1
    one.peer.stand_behind(ECHO)
    for call in (one.driver.off, one.driver.off, lambda: one.driver.select(6)):
        with pytest.raises(DeviceTimeout, match="received only an echo"):
            call()
    assert one.lit() == [5]


def test_a_line_that_echoes_no_more_is_learnt_anew(bench):
    one = bench(RTU, connect=False)
    one.peer.stand_behind(ECHO)
    one.driver.connect()
    one.peer.stand_behind(Adapter())
    with pytest.raises(DeviceTimeout):
        one.driver.select(5)
    one.driver.off()
    assert one.lit() == []
    one.driver.select(6)
    assert one.lit() == [6]


@pytest.mark.parametrize("where", ["before", "after"])
def test_line_feed_around_a_reply_is_reported_and_alone_is_no_reply(bench, where):
    one = bench(RTU)
    one.driver.select(5)
    one.peer.stand_behind(Adapter(**{where: b"\n"}))
    with pytest.raises(DeviceError, match=r"lamp 6 on: .*received no reply in \d+ bytes: .*0a"):
        one.driver.select(6)
    one.peer.stand_behind(Adapter())
    one.driver.off()
    assert one.lit() == []
    one.driver.select(7)
    assert one.lit() == [7]


def test_a_line_feed_alone_is_no_reply(bench):
    one = bench(RTU)
    send = one.peer._terminal.send
    one.peer._terminal.send = lambda _reply: send(b"\n")
    with pytest.raises(DeviceTimeout, match=r"lamp 5 on: .*received no reply in 1 bytes: 0a"):
        one.driver.select(5)
    one.peer._terminal.send = send
    one.driver.off()
    assert one.lit() == []


@pytest.mark.parametrize("adapter", HARMLESS, ids=NAMES)
def test_a_widget_s_line_that_echoes(bench, adapter):
    one = bench(DMX, connect=False)
    one.peer.stand_behind(adapter)
    one.driver.connect()
    for lamp in (5, 199):
        one.driver.select(lamp)
        assert one.lit() == [lamp]
    one.driver.off()
    assert one.lit() == []


def test_an_echo_without_a_widget_is_no_reply(bench):
    one = bench(DMX, Fault("lights", "hang", 0), connect=False)
    one.peer.stand_behind(ECHO)
    for call in (one.driver.off, one.driver.connect, one.driver.all_on):
        with pytest.raises(DeviceTimeout, match="received an echo"):
            call()


@contextmanager
def changed(port: int, change: Callable[[bytes], bytes]) -> Iterator[int]:
    """A proxy in front of `port` that hands on `change(answer)`; its own port."""

    def carry(client: socket.socket) -> None:
        with client, socket.create_connection(("127.0.0.1", port)) as bank, suppress(OSError):
            while request := client.recv(4096):
                bank.sendall(request)
                client.sendall(change(bank.recv(4096)))

    def serve() -> None:
        with suppress(OSError):
            while True:
                threading.Thread(target=carry, args=(listener.accept()[0],), daemon=True).start()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=serve, daemon=True).start()
        yield listener.getsockname()[1]
        listener.shutdown(socket.SHUT_RDWR)


CHANGES: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "a length of 65535": (
        lambda a: a[:4] + b"\xff\xff" + a[6:] + bytes(65529),
        r"protocol 0, length \d+, unit 1, received transaction \d+, protocol 0, length 65535",
    ),
    "a length of one more": (
        lambda a: a[:5] + bytes([a[5] + 1]) + a[6:] + b"\0",
        r"received transaction \d+, protocol 0, length \d+, unit 1\.",
    ),
    "another transaction": (
        lambda a: bytes([a[0] ^ 1]) + a[1:],
        r"expected .*transaction (\d), protocol.*received transaction 25\d, protocol",
    ),
    "another protocol": (lambda a: a[:3] + b"\1" + a[4:], "received transaction .*, protocol 1"),
    "another unit": (lambda a: a[:6] + b"\2" + a[7:], r"unit 1, received .*unit 2\."),
    "another function": (
        lambda a: a[:7] + bytes([a[7] ^ 1]) + a[8:],
        "received (function|transaction)",
    ),
    "bytes behind it": (
        lambda a: a + b"more",
        "nothing behind it, received no reply in 4 bytes: 6d 6f 72 65",
    ),
    "two of each": (lambda a: a + a, r"nothing behind it, received no reply in \d+ bytes"),
    "a count of bytes that is not so": (
        lambda a: a[:8] + bytes([a[8] + 1]) + a[9:] if a[7] in (3, 4) else a,
        "received function [34] in",
    ),
}


@pytest.mark.parametrize("change", CHANGES)
def test_modbus_tcp_reply_that_mismatches_its_request_is_rejected(bench, change):
    """F22: what was expected and received is named, and the bank's word is not taken."""
    one = bench(TCP, connect=False)
    make, text = CHANGES[change]
    config = one.driver.config
    with changed(config.port, make) as port:
        driver = ModbusLightBank(config.model_copy(update={"port": port}), one.driver.count)
        for call in (driver.off, driver.connect, driver.status, lambda: driver.select(3)):
            with pytest.raises(DeviceError, match=text):
                call()
        assert one.lit() == []
        driver.close()


def test_off_is_sent_before_anything_is_refused(bench):
    one = bench(TCP)
    one.driver.all_on()
    make, _ = CHANGES["two of each"]
    config = one.driver.config
    with changed(config.port, make) as port:
        driver = ModbusLightBank(config.model_copy(update={"port": port}), one.driver.count)
        with pytest.raises(DeviceError):
            driver.off()
        driver.close()
    assert one.lit() == []


def test_a_place_that_sends_back_what_it_gets_is_no_bank(slack):
    def echo() -> None:
        with suppress(OSError):
            while True:
                with listener.accept()[0] as link:
                    while data := link.recv(4096):
                        link.sendall(data)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=echo, daemon=True).start()
        port = listener.getsockname()[1]
        driver = ModbusLightBank(ModbusTcpConfig(port=port, timeout_s=0.5 * slack), 8)
        for call in (driver.off, driver.connect, lambda: driver.select(3)):
            with pytest.raises(DeviceTimeout, match=r"only an echo.*check host and port"):
                call()
        driver.close()
        listener.shutdown(socket.SHUT_RDWR)


def test_reply_of_another_unit_on_the_line_is_rejected(bench):
    one = bench(RTU)
    send = one.peer._terminal.send

    def from_unit_9(frame: bytes) -> None:
        body = b"\x09" + frame[1:-2]
        send(body + struct.pack("<H", _crc(body)))

    one.peer._terminal.send = from_unit_9
    with pytest.raises(DeviceError, match=r"unit 7, received unit 9\."):
        one.driver.select(3)


def _crc(data: bytes) -> int:
    remainder = 0xFFFF
    for byte in data:
        remainder ^= byte
        for _ in range(8):
            remainder = remainder >> 1 ^ (0xA001 if remainder & 1 else 0)
    return remainder
