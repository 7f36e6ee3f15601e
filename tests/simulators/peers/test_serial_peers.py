"""Trigger box and projector controller over their pseudo-terminals."""

from __future__ import annotations

import pytest

from simulators.peers.faults import Fault


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


def test_links_are_stable_names_and_go_away(start, tmp_path):
    bench = start()
    link = tmp_path / "state0" / "trigger"
    assert bench.wires["trigger"]["port"] == str(link)
    assert link.is_symlink()
    bench.stage.__exit__(None, None, None)
    assert not link.is_symlink()
    assert not (tmp_path / "state0" / "devices.toml").exists()
