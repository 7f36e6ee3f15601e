"""The light bank over Modbus TCP."""

from __future__ import annotations

import pytest

from simulators.peers.faults import Fault
from simulators.peers.lamps import Lamps

ILLEGAL_ADDRESS, ILLEGAL_VALUE = 2, 3


def status(bench):
    return bench.lights.read_input_registers(0, count=4).registers


def coils(bench):
    return bench.lights.read_coils(0, count=5).bits[:5]


def test_coils_one_by_one_and_together(bench):
    bench.lights.write_coil(3, True)
    bench.lights.write_coils(0, [True, True])
    assert coils(bench) == [True, True, False, True, False]
    assert bench.lights.read_holding_registers(1000).registers == [65534]


def test_level_zero_is_not_lit(bench):
    bench.lights.write_registers(1, [0, 32768])
    bench.lights.write_coils(1, [True, True])
    assert status(bench)[:2] == [0b1000, 1]
    assert bench.world.lamps.power() == pytest.approx([0, 0, 32768 / 65535, 0, 0])


@pytest.mark.parametrize(("address", "value"), [(1002, 99), (1002, 60001), (1000, 6)])
def test_values_out_of_range_are_refused(bench, address, value):
    reply = bench.lights.write_register(address, value)
    assert reply.isError()
    assert reply.exception_code == ILLEGAL_VALUE
    assert bench.lights.read_holding_registers(1000, count=3).registers == [0, 0, 2000]


def test_unknown_addresses_are_refused(bench):
    assert bench.lights.write_register(5, 1).exception_code == ILLEGAL_ADDRESS
    assert bench.lights.write_coil(5, True).exception_code == ILLEGAL_ADDRESS
    assert bench.lights.read_holding_registers(1021).exception_code == ILLEGAL_ADDRESS


def test_watchdog_puts_lamps_off_until_commanded_again(bench):
    bench.lights.write_register(1002, 500)
    bench.lights.write_register(1001, 7)
    bench.select(65535)
    bench.now[0] += 0.5
    assert status(bench)[1] == 5
    bench.now[0] += 0.01
    assert status(bench)[:2] == [0b0001, 0]
    assert coils(bench) == [False] * 5
    bench.lights.write_register(1001, 8)
    assert status(bench)[:2] == [0, 0]
    bench.select(1)
    assert status(bench)[:2] == [0b1000, 1]


def test_time_in_the_dark_does_not_count(bench):
    bench.now[0] += 3600
    bench.select(1)
    assert status(bench)[:2] == [0b1000, 1]


def test_interlock_cuts_the_lamps(start):
    bench = start(Fault("trigger", "interlock", 1))
    bench.select(65535)
    assert bench.trigger.send("PULSE 1000") == "OK 1"
    assert status(bench)[:2] == [0b0010, 0]
    bench.select(65535)
    assert status(bench)[1] == 0


@pytest.mark.parametrize("count", [0, 1001])
def test_lamps_beyond_the_address_map_are_refused(count):
    with pytest.raises(ValueError, match="1 to 1000 lamps"):
        Lamps(count)
