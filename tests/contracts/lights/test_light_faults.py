"""Faults on the light bank's wire: told, nothing stays lit, and the next request is answered right.

After one late RTU answer every later one would be the previous request's; here none is taken.
"""

from __future__ import annotations

import re
import time

import pytest
from waiting import until

from simulators.peers.dmx_widget import DmxWidget
from simulators.peers.faults import Fault
from stage_service.devices.errors import DeviceError, DeviceTimeout, DeviceUnreachable

TCP, RTU, DMX = "simulated TCP", "simulated RTU", "simulated DMX"
LATE_S = 0.3  # the drivers' deadline is 0.2 s
SELECT, STATUS, OFF = "6 1000", "4 0", "6 1003"

MESSAGES = {
    "silent": (DeviceTimeout, "expected a reply within {timeout} s, received nothing"),
    "late": (DeviceTimeout, "expected a reply within {timeout} s, received nothing"),
    "garbage": (DeviceTimeout, "within {timeout} s, received no reply in 10 bytes: 00 ff 68 73"),
    "crc": (DeviceTimeout, "within {timeout} s, received no reply in 8 bytes: 07 06 03 e8"),
    "nak": (DeviceError, r"expected a reply, received Modbus exception 4 \(refused now\)"),
    "echo": (DeviceError, "expected the reply function 6, 6 at 1000, received function 6, 7 at"),
    "unplug": (DeviceUnreachable, "expected a reply within {timeout} s, received none"),
}
# On TCP its header says at once that it is no answer.
GARBAGE_ON_TCP = (DeviceError, "length 6, unit 1, received transaction 255, protocol 26739")


def goes_dark(one):
    """Whether `off` was carried out; not as long as the bank is unplugged."""
    try:
        one.driver.off()
    except DeviceUnreachable:
        return False
    return True


def wires(*without_on_tcp):
    return [(w, k) for k in MESSAGES for w in (TCP, RTU) if not (w == TCP and k in without_on_tcp)]


@pytest.mark.parametrize(("wire", "kind"), wires("crc"))
def test_disturbed_command_is_reported_and_later_ones_succeed(bench, wire, kind):
    one = bench(wire, Fault("lights", kind, 1, request=SELECT, seconds=LATE_S))
    one.driver.off()
    one.pulses = 1
    error, text = GARBAGE_ON_TCP if (wire, kind) == (TCP, "garbage") else MESSAGES[kind]
    timeout_s = one.driver.config.timeout_s
    text = text.format(timeout=f"{timeout_s:g}")
    began = time.monotonic()
    with pytest.raises(error, match="putting lamp 5 on: .*" + text) as caught:
        one.driver.select(5)
    assert time.monotonic() - began < 3 * timeout_s  # one deadline, not several
    assert caught.value.device == one.driver.name
    assert caught.value.operation == "putting lamp 5 on"
    assert caught.value.todo
    until(lambda: goes_dark(one))
    assert one.lit() == []
    for lamp in (7, 8):
        one.driver.select(lamp)
        assert one.lit() == [lamp]
        assert one.driver.status().lit == 1
    one.driver.heartbeat()
    one.driver.off()
    assert one.lit() == []


@pytest.mark.parametrize("kind", ["silent", "late", "garbage", "crc", "nak", "unplug"])
def test_disturbed_reading_is_reported_and_later_ones_succeed(bench, kind):
    one = bench(RTU, Fault("lights", kind, 1, request=STATUS, seconds=LATE_S))
    one.pulses = 1
    with pytest.raises(DeviceError, match="reading the status"):
        one.driver.status()
    until(one.plugged)
    one.driver.select(5)
    assert one.driver.status().lit == 1
    assert one.driver.position() == 0
    one.driver.off()
    assert one.driver.status().lit == 0


def test_bytes_before_an_rtu_reply_are_skipped(bench):
    one = bench(RTU, Fault("lights", "noise", 1, request=SELECT))
    one.pulses = 1
    with pytest.raises(DeviceTimeout, match=r"lamp 5 on: .* received no reply in 18 bytes: 00 ff"):
        one.driver.select(5)
    one.driver.off()
    assert one.lit() == []
    one.driver.select(6)
    assert one.lit() == [6]


@pytest.mark.parametrize("wire", [TCP, RTU])
def test_a_bank_that_is_always_late_is_never_believed(bench, wire):
    late = [Fault("lights", "late", 1, seconds=LATE_S) for _ in range(12)]
    one = bench(wire, *late)
    one.driver.select(3)
    one.pulses = 1
    for _ in range(4):
        with pytest.raises(DeviceError):
            one.driver.status()
    one.faults = type(one.faults)()
    one.driver.off()
    assert one.lit() == []
    one.driver.select(4)
    assert (one.lit(), one.driver.status().lit) == ([4], 1)


@pytest.mark.parametrize("wire", [TCP, RTU])
def test_off_reaches_a_bank_whose_replies_are_lost(bench, wire):
    one = bench(wire, *[Fault("lights", "silent", 1) for _ in range(9)])
    one.driver.all_on()
    one.pulses = 1
    with pytest.raises(DeviceTimeout):
        one.driver.status()
    with pytest.raises(DeviceTimeout, match="putting all lamps off"):
        one.driver.off()
    until(lambda: one.lit() == [])


@pytest.mark.parametrize("wire", [TCP, RTU])
def test_a_mute_bank_is_noticed_in_time_and_its_watchdog_puts_the_lamps_off(bench, wire):
    now = [50.0]
    one = bench(wire, Fault("lights", "hang", 1), clock=lambda: now[0])
    one.driver.set_watchdog(0.5)
    one.driver.all_on()
    one.pulses = 1
    for call in (one.driver.off, one.driver.status, one.driver.off):
        began = time.monotonic()
        with pytest.raises(DeviceTimeout, match="its watchdog switches the lamps off"):
            call()
        assert time.monotonic() - began < 2 * one.driver.config.timeout_s
    assert len(one.lit()) == 200
    now[0] += 0.51
    assert one.lit() == []


@pytest.mark.parametrize("wire", [TCP, RTU])
def test_an_unplugged_bank_comes_back(bench, wire):
    one = bench(wire, Fault("lights", "unplug", 1, seconds=0.3))
    one.driver.all_on()
    one.pulses = 1
    for _ in range(2):
        with pytest.raises(DeviceUnreachable, match=re.escape(one.driver.name)):
            one.driver.off()
    until(lambda: goes_dark(one))
    assert one.lit() == []


@pytest.mark.parametrize("wire", [TCP, RTU])
def test_a_lamp_stuck_on_is_detected(bench, wire):
    one = bench(wire)
    one.driver.select(5)
    one.lamps.stick()
    with pytest.raises(DeviceError, match="all lamps off: expected 0 lamps lit, received 1 lit"):
        one.driver.off()
    with pytest.raises(DeviceError, match="expected 1 lamp lit, received 2 lit"):
        one.driver.select(6)


@pytest.mark.parametrize("wire", [TCP, RTU])
def test_a_bank_that_lies_about_its_lamps_is_caught_when_they_are_put_on(bench, wire):
    one = bench(wire, Fault("lights", "lies", 1))
    one.pulses = 1
    with pytest.raises(DeviceError, match="expected 1 lamp lit, received 0 lit"):
        one.driver.select(5)
    one.driver.off()
    assert one.lit() == []


def test_the_cause_of_dark_lamps_is_reported(bench):
    one = bench(TCP)
    one.lamps.cut_by(lambda: (False, True))
    with pytest.raises(DeviceError, match=r"0 lit, the emergency stop is pressed. Clear the cause"):
        one.driver.select(1)


def test_a_count_without_a_cause_is_a_contradiction(bench):
    one = bench(TCP, Fault("lights", "lies", 1))
    one.pulses = 1
    with pytest.raises(DeviceError, match=r"received 0 lit\. The bank reported lamps as off"):
        one.driver.select(1)


@pytest.mark.parametrize("request_", ["16 2000", "3 2000", "6 1003"])
@pytest.mark.parametrize("kind", ["silent", "nak", "late", "crc", "unplug"])
def test_a_sequence_whose_upload_is_disturbed_is_not_armed(bench, kind, request_):
    one = bench(RTU, Fault("lights", kind, 1, request=request_, seconds=LATE_S))
    one.driver.off()  # so that the next write of register 1003 arms
    one.pulses = 1
    with pytest.raises(DeviceError, match=r"loading a sequence of 70 steps|lamps off"):
        one.driver.load_sequence([(i, 1.0) for i in range(70)])
    until(one.plugged)
    one.driver.off()
    one.lamps.gate(True)
    assert one.lit() == []
    one.lamps.gate(False)
    one.driver.load_sequence([(9, 1.0)])
    one.lamps.gate(True)
    assert one.lit() == [9]


def test_a_table_that_reads_back_otherwise_is_not_armed(bench):
    one = bench(TCP)
    load = one.lamps.load
    one.lamps.load = lambda first, words: load(first, [*words[:-1], 0])
    with pytest.raises(DeviceError, match="reading the table back: expected 65535 at register"):
        one.driver.load_sequence([(i, 1.0) for i in range(70)])
    one.lamps.gate(True)
    assert one.lit() == []


@pytest.mark.parametrize("kind", ["silent", "garbage", "late", "unplug"])
def test_dmx_faults_are_reported(bench, kind):
    one = bench(DMX, Fault("lights", kind, 1, request="3", seconds=LATE_S))
    one.driver.select(5)
    one.pulses = 1
    with pytest.raises(DeviceError, match=r"lamp 6 on: expected .* within .* s.* still be lit"):
        one.driver.select(6)
    until(one.plugged)
    one.driver.off()
    assert one.lit() == []
    one.driver.select(7)
    assert one.lit() == [7]


@pytest.mark.parametrize("widget", ["by Enttec", "that ignores what user data it is asked for"])
def test_late_dmx_reply_is_not_matched_to_the_next_request(bench, widget, monkeypatch):
    execute = DmxWidget._execute
    if widget != "by Enttec":
        monkeypatch.setattr(
            DmxWidget,
            "_execute",
            lambda self, label, data: execute(self, label, b"\0\0" if label == 3 else data),
        )
    late = Fault("lights", "late", 1, request="3", seconds=LATE_S)
    never = Fault("lights", "silent", 1, request="3")
    one = bench(DMX, late, never)
    one.driver.select(5)
    one.pulses = 1
    with pytest.raises(DeviceTimeout, match="putting lamp 6 on"):
        one.driver.select(6)
    with pytest.raises(DeviceTimeout, match="putting lamp 7 on"):
        one.driver.select(7)  # within its deadline comes the answer to the one before
    for lamp in range(8, 50):
        one.driver.select(lamp)
        assert one.lit() == [lamp]
    assert one.requests.count("3") == 46  # one of them when it connected


def test_noise_before_a_widgets_reply_is_skipped(bench):
    one = bench(DMX, Fault("lights", "noise", 1, request="3"))
    one.pulses = 1
    one.driver.select(6)
    assert one.lit() == [6]


def test_dmx_lamps_stay_lit_without_a_heartbeat_as_capabilities_state(bench):
    now = [50.0]
    one = bench(DMX, Fault("lights", "hang", 1), clock=lambda: now[0])
    one.driver.select(5)
    one.pulses = 1
    with pytest.raises(DeviceTimeout, match="Its lamps may still be lit"):
        one.driver.off()
    now[0] += 3600
    assert one.lit() == [5]
    assert not one.driver.capabilities.dead_man
