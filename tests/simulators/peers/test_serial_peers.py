"""Trigger box and projector controller over their pseudo-terminals."""

from __future__ import annotations

import pytest

from simulators.peers.faults import Fault


def test_trigger_counts_and_resets(bench):
    send = bench.trigger.send
    assert send("ID?") == "HAIRSTAGE-TRIGGER 2 4096"
    assert send("COUNT?") == "COUNT 0"
    assert send("PULSE 20000") == "OK 1"
    assert send("PULSE 1") == "OK 2"
    assert send("COUNT?") == "COUNT 2"
    assert send("RESET") == "OK 0"
    assert send("COUNT?") == "COUNT 0"
    assert send("STATUS?") == "STATUS interlock=0 estop=0"


@pytest.mark.parametrize("line", ["PULSE 0", "PULSE 10000001", "PULSE -5", "PULSE 1.5", "PULSE x"])
def test_trigger_refuses_bad_exposures(bench, line):
    assert bench.trigger.send(line).startswith("ERR 2 ")
    assert bench.trigger.send("COUNT?") == "COUNT 0"


@pytest.mark.parametrize("line", ["", "pulse 1", "FIRE", "PULSE", "PULSE 1 2", "ID?  "])
def test_unknown_commands_are_reported_as_unknown(bench, line):
    assert bench.trigger.send(line).startswith("ERR 1 ")
    assert bench.projectors.send(line).startswith("ERR 1 ")


def test_bytes_that_are_not_ascii_do_not_end_the_box(bench):
    bench.trigger.port.write(b"\xff\xfe\n")
    assert bench.trigger.port.readline() == b"ERR 1 not ASCII\n"
    assert bench.trigger.send("COUNT?") == "COUNT 0"


def test_projectors_show_the_commanded_pattern(bench):
    send = bench.projectors.send
    assert send("ID?") == "HAIRSTAGE-PROJECTORS 2 4096 proj"
    assert send("SHOW?") == "SHOW OFF"
    for command in ("LINE proj 7 65535", "ON 32768", "OFF"):
        assert send(command) == f"OK {command}"
        assert send("SHOW?") == f"SHOW {command}"


@pytest.mark.parametrize(
    "line", ["LINE other 0 1", "LINE proj 8 1", "LINE proj -1 1", "LINE proj 0 65536", "ON 65536"]
)
def test_projectors_refuse_bad_arguments(bench, line):
    bench.projectors.send("ON 5")
    assert bench.projectors.send(line).startswith("ERR 2 ")
    assert bench.projectors.send("SHOW?") == "SHOW ON 5"


def test_interlock_refuses_pulses(start):
    bench = start(Fault("trigger", "interlock", 1), Fault("trigger", "estop", 1))
    assert bench.trigger.send("PULSE 1000") == "OK 1"
    assert bench.trigger.send("STATUS?") == "STATUS interlock=1 estop=1"
    assert bench.trigger.send("PULSE 1000").startswith("ERR 3 ")
    assert bench.trigger.send("COUNT?") == "COUNT 1"


def test_silent_and_broken_replies_come_once(start):
    bench = start(Fault("trigger", "silent", 1), Fault("trigger", "garbage", 2))
    assert bench.trigger.send("PULSE 1000") == ""
    assert bench.trigger.send("COUNT?") == "COUNT 1"
    assert not bench.trigger.send("PULSE 1000").startswith("OK")
    assert bench.trigger.send("PULSE 1000") == "OK 3"
    bench = start(Fault("projectors", "silent", 0), Fault("projectors", "garbage", 0))
    assert bench.projectors.send("ON 5") == ""
    assert bench.projectors.send("ON 6") != "OK ON 6"
    assert bench.projectors.send("SHOW?") == "SHOW ON 6"


def test_links_are_stable_names_and_go_away(start, tmp_path):
    bench = start()
    link = tmp_path / "state0" / "trigger"
    assert bench.wires["trigger"]["port"] == str(link)
    assert link.is_symlink()
    bench.stage.__exit__(None, None, None)
    assert not link.is_symlink()
    assert not (tmp_path / "state0" / "devices.toml").exists()
