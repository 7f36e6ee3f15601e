"""The simulated light bank against clients that nobody here wrote.

The other way round, the driver against pyModbusTCP's server, is a row of the contract suite.
"""

from __future__ import annotations

import re
import shutil
import subprocess

import pytest
from pyModbusTCP.client import ModbusClient

RTU_LINE = ("-m", "rtu", "-a", "7", "-b", "115200", "-P", "none", "-s", "2")


@pytest.fixture
def client(bench):
    """pyModbusTCP's client of a simulated bank, and the bank's lamps."""
    one = bench("simulated TCP", connect=False)
    client = ModbusClient("127.0.0.1", one.driver.config.port, 1, timeout=2.0, auto_open=True)
    yield client, one
    client.close()


def test_pymodbustcp_reads_and_writes_every_table(client):
    run_client, one = client
    assert run_client.read_input_registers(0, 5) == [0, 0, 200, 0x4853, 0]
    assert run_client.write_single_register(1000, 3)
    assert one.lit() == [2]
    assert run_client.read_coils(0, 5) == [False, False, True, False, False]
    assert run_client.write_multiple_coils(0, [True, True, False])
    assert run_client.write_single_coil(199, True)
    assert one.lit() == [0, 1, 199]
    assert run_client.read_holding_registers(1000, 4) == [65534, 0, 2000, 0]
    assert run_client.write_multiple_registers(0, [32768] * 123)
    assert run_client.read_holding_registers(121, 3) == [32768, 32768, 65535]
    assert run_client.write_multiple_registers(2000, [8, 65535])
    assert run_client.write_single_register(1003, 1)
    one.lamps.gate(True)
    assert one.lit() == [7]
    one.lamps.gate(False)
    assert run_client.read_input_registers(4, 1) == [1]


@pytest.mark.parametrize(
    ("call", "exception"),
    [
        (lambda c: c.read_discrete_inputs(0, 1), 1),
        (lambda c: c.read_input_registers(0, 6), 2),
        (lambda c: c.write_single_coil(200, True), 2),
        (lambda c: c.write_multiple_registers(1900, [1, 2]), 2),
        (lambda c: c.write_single_register(1000, 201), 3),
        (lambda c: c.write_single_register(1002, 99), 3),
        (lambda c: c.write_single_register(1003, 4097), 3),
        (lambda c: c.write_single_register(1003, 1) and c.write_single_register(1000, 1), 4),
    ],
)
def test_pymodbustcp_understands_the_exceptions(client, call, exception):
    run_client, one = client
    assert not call(run_client)
    assert run_client.last_except == exception
    assert one.lit() == []


@pytest.fixture(params=["simulated TCP", "simulated RTU"])
def mbpoll(request, bench):
    """`mbpoll(*arguments)`: what libmodbus' client makes of a simulated bank."""
    if shutil.which("mbpoll") is None:
        pytest.skip("mbpoll is missing: apt-get install mbpoll")
    one = bench(request.param, connect=False)
    tcp = request.param.endswith("TCP")
    line = ("-m", "tcp", "-p", str(one.driver.config.port)) if tcp else RTU_LINE
    place = "127.0.0.1" if tcp else one.driver.config.port

    def run_client(*arguments, values=()):
        command = ["mbpoll", *line, "-0", "-1", "-o", "2", *arguments, place, *values]
        for _ in range(3):  # a pause inside a frame, as on a busy machine, ends it for RTU
            done = subprocess.run(command, capture_output=True, text=True, timeout=20)
            said = done.stdout + done.stderr
            if "timed out" not in said:
                break
        read = {int(a): int(v) for a, v in re.findall(r"^\[(\d+)\]:\s+(\d+)", said, re.MULTILINE)}
        return read, said

    run_client.bank = one
    return run_client


def test_mbpoll_reads(mbpoll):
    assert mbpoll("-t", "3", "-r", "0", "-c", "4")[0] == {0: 0, 1: 0, 2: 200, 3: 0x4853}
    assert mbpoll("-t", "4", "-r", "1000", "-c", "3")[0] == {1000: 0, 1001: 0, 1002: 2000}
    assert mbpoll("-t", "4", "-r", "0", "-c", "125")[0] == dict.fromkeys(range(125), 65535)


def test_mbpoll_writes(mbpoll):
    assert "Written 1 references" in mbpoll("-t", "4", "-r", "1000", values=["4"])[1]
    assert mbpoll.bank.lit() == [3]
    assert mbpoll("-t", "0", "-r", "0", "-c", "5")[0] == {0: 0, 1: 0, 2: 0, 3: 1, 4: 0}
    assert "Written 3 references" in mbpoll("-t", "0", "-r", "0", values=["1", "0", "1"])[1]
    assert mbpoll.bank.lit() == [0, 2, 3]
    levels = [600 * i for i in range(1, 101)]
    said = mbpoll("-t", "4", "-r", "0", values=[str(level) for level in levels])[1]
    assert "Written 100 references" in said
    assert mbpoll.bank.lamps.levels()[:101] == [*levels, 65535]


def test_mbpoll_understands_the_exceptions(mbpoll):
    assert "Illegal data value" in mbpoll("-t", "4", "-r", "1002", values=["50"])[1]
    assert "Illegal data address" in mbpoll("-t", "3", "-r", "5", "-c", "1")[1]
    assert mbpoll.bank.lit() == []
