"""Serial light banks byte by byte, as their standards have it."""

from __future__ import annotations

import struct
import time

import pytest
import serial

from simulators.peers.dmx_widget import DmxWidget
from simulators.peers.lamps import Lamps
from simulators.peers.modbus_rtu import ModbusRtuPeer, with_crc
from simulators.peers.modbus_unit import DisturbedUnit, ModbusUnit
from stage_service.device_config import ModbusRtuConfig

SELECT_2 = bytes.fromhex("07 06 03e8 0002")
SELECT_0 = bytes.fromhex("07 06 03e8 0000")


def test_crc_of_a_well_known_frame():
    assert with_crc(bytes.fromhex("01 03 0000 000a")).hex() == "01030000000ac5cd"


@pytest.fixture
def rtu(tmp_path):
    """A bank of 5 lamps as unit 7 at 9600 baud, paced, and its port."""
    lamps = Lamps(5)
    config = ModbusRtuConfig(kind="modbus_rtu", port="x", baud=9600, unit=7)
    peer = ModbusRtuPeer(DisturbedUnit(ModbusUnit(lamps)), config, tmp_path / "l", paced=True)
    with serial.Serial(None, timeout=10) as port:
        port.port = peer.start()
        port.open()
        yield lamps, port
    peer.stop()


def test_a_reply_takes_the_time_of_the_line(rtu):
    lamps, port = rtu
    began = time.monotonic()
    port.write(with_crc(SELECT_2))
    assert port.read(8) == with_crc(SELECT_2)
    # 8 characters of 11 bits each way and 3.5 between, at 9600 baud.
    assert time.monotonic() - began >= (8 + 3.5 + 8) * 11 / 9600
    assert lamps.power().tolist() == [0, 1, 0, 0, 0]


@pytest.mark.parametrize(
    "frame",
    [
        with_crc(SELECT_2)[:-1] + b"\0",
        with_crc(b"\x08" + SELECT_2[1:]),
        with_crc(SELECT_2)[:-1],
        with_crc(SELECT_2) + b"\1",
        b"\x07",
    ],
    ids=["wrong CRC", "other unit", "cut short", "a byte too many", "one byte"],
)
def test_requests_to_another_unit_get_no_reply_and_no_effect(rtu, frame):
    lamps, port = rtu
    port.timeout = 0.05
    port.write(frame)
    assert port.read(1) == b""
    assert not lamps.power().any()
    port.timeout = 10
    port.write(with_crc(SELECT_2))
    assert port.read(8) == with_crc(SELECT_2)


def test_a_broadcast_takes_effect_without_a_reply(rtu):
    lamps, port = rtu
    port.write(with_crc(SELECT_2))
    port.read(8)
    port.timeout = 0.05
    port.write(with_crc(b"\0" + SELECT_0[1:]))
    assert port.read(1) == b""
    assert not lamps.power().any()


def message(label, data=b""):
    return struct.pack("<BBH", 0x7E, label, len(data)) + data + b"\xe7"


PARAMETERS = message(3, bytes.fromhex("4401 09 01 28"))


@pytest.fixture
def widget(tmp_path):
    """A widget whose 5 dimmers begin at channel 3, and its port."""
    lamps = Lamps(5)
    peer = DmxWidget(lamps, 3, tmp_path / "w")
    with serial.Serial(None, timeout=10) as port:
        port.port = peer.start()
        port.open()
        yield lamps, port
    peer.stop()


def test_the_widget_reports_its_parameters_user_data_and_serial_number(widget):
    _, port = widget
    port.write(message(3, b"\0\0") + message(10) + message(3, b"\2\0"))
    expected = PARAMETERS + message(10, bytes.fromhex("78563412"))
    expected += message(3, bytes.fromhex("4401 09 01 28 00 00"))
    assert port.read(len(expected)) == expected


def test_the_widget_takes_frames_in_pieces_and_among_garbage(widget):
    lamps, port = widget
    channels = bytes([9, 9, 255, 0, 128, 0, 1]) + bytes(17)
    stream = b"\x7e\x7e\x06\xff\xff junk \xe7" + message(6, b"\0" + channels)
    for byte in stream:
        port.write(bytes([byte]))
    port.write(message(3, b"\0\0"))
    assert port.read(len(PARAMETERS)) == PARAMETERS
    assert lamps.power() == pytest.approx([1, 0, 128 / 255, 0, 1 / 255])


@pytest.mark.parametrize(
    "data",
    [b"\0" + b"\xff" * 23, b"\0" + b"\xff" * 513, b"\xcc" + b"\xff" * 24],
    ids=["too short", "too long", "another start code"],
)
def test_frames_that_are_not_dmx_change_nothing(widget, data):
    lamps, port = widget
    port.write(message(6, data) + message(3, b"\0\0"))
    assert port.read(len(PARAMETERS)) == PARAMETERS
    assert not lamps.power().any()
