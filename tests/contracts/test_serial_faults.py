"""Each fault of a serial wire, at a real one: named, no gate left open, the next answer right."""

from __future__ import annotations

import pytest
from waiting import until

from simulators.peers.faults import Fault
from stage_service.devices.errors import DeviceError, DeviceTimeout, DeviceUnreachable
from stage_service.devices.projectors.interface import Pattern
from stage_service.devices.trigger.interface import TableRow

TIMEOUT_S = 0.25
LATE_S = 0.37  # after the driver's deadline, before that of the next request
LONG = TableRow(1, "LP", 0.0, 9.0, 0.0)
WIRE = {
    "silent": (DeviceTimeout, "expected a line within {timeout} s, received nothing"),
    "garbage": (DeviceError, r"expected a reply to .* within {timeout} s, received '.\\x7f"),
    "nak": (DeviceError, "received 'ERR 4 busy'"),
    "late": (DeviceTimeout, "expected a line within {timeout} s, received nothing"),
    "noise": (DeviceError, r"received '\\\\xff\\x00\\x1b\[A~~'"),
    "unplug": (DeviceUnreachable, "expected an open serial port within {timeout} s, received"),
}
TRIGGER = {
    "PULSE": ("firing the cameras", lambda s: s.trigger.pulse(0.001)),
    "COUNT?": ("reading the pulse count", lambda s: s.trigger.count()),
    "RESET": ("resetting the pulse count", lambda s: s.trigger.reset()),
    "STATUS?": ("reading the safety inputs", lambda s: s.trigger.status()),
    "WATCHDOG": ("setting the watchdog", lambda s: s.trigger.load_table([LONG], 1.0)),
    "TABLE": ("beginning a table", lambda s: s.trigger.load_table([LONG], 1.0)),
    "ROW": ("uploading row 0 of the table", lambda s: s.trigger.load_table([LONG], 1.0)),
    "ARM": ("arming the table", lambda s: s.trigger.load_table([LONG], 1.0)),
    "SEQ?": ("reading the table's progress", lambda s: s.trigger.progress()),
    "STOP": ("stopping the table", lambda s: s.trigger.stop()),
}
ROWS = [Pattern(1.0, "left", row) for row in range(3)]
PROJECTORS = {
    "LINE": ("showing row 1 of left", lambda s: s.projectors.line("left", 1, 1.0)),
    "ON": ("showing all rows", lambda s: s.projectors.all_on(1.0)),
    "OFF": ("putting the projectors dark", lambda s: s.projectors.off()),
    "SHOW?": ("reading what is shown", lambda s: s.projectors.is_dark()),
    "WATCHDOG": ("setting the watchdog", lambda s: s.projectors.set_watchdog(1.0)),
    "SEQ": ("beginning a sequence", lambda s: s.projectors.load_sequence(ROWS)),
    "ENTRY": ("uploading entry 0 of the sequence", lambda s: s.projectors.load_sequence(ROWS)),
    "ARM": ("arming the sequence", lambda s: s.projectors.load_sequence(ROWS)),
}


@pytest.fixture
def start(serial_stage):
    """A stage whose trigger box may run `LONG`: the projectors' first pattern is armed."""

    def begin(*faults):
        stage = serial_stage(*faults, timeout_s=TIMEOUT_S)
        for line in ("WATCHDOG 60000", "SEQ 1", "ENTRY 0 LINE left 0 1 99 9", "ARM"):
            assert stage.controller.reply(line).startswith("OK")
        return stage

    return begin


def fails(kind, device, operation, call, stage):
    error, text = WIRE[kind]
    with pytest.raises(error, match=text.format(timeout=f"{stage.timeout_s:g}")) as caught:
        call(stage)
    assert type(caught.value) is error
    assert caught.value.device == f"{device} ({stage.port_of(device)})"
    assert caught.value.operation == operation
    assert caught.value.deadline_s == stage.timeout_s
    assert caught.value.todo


@pytest.mark.parametrize("request_word", TRIGGER)
@pytest.mark.parametrize("kind", WIRE)
def test_trigger_box(start, kind, request_word):
    stage = start(Fault("trigger", kind, 0, request=request_word, seconds=LATE_S))
    operation, call = TRIGGER[request_word]
    fails(kind, "trigger box", operation, call, stage)
    if kind == "unplug":
        with pytest.raises(DeviceUnreachable, match=r"opening the serial port: .*within"):
            stage.trigger.status()
        until(lambda: stage.plugged("trigger"))
    # What was lost may have been carried out, and is never sent again by itself.
    fired = request_word == "PULSE" and kind not in ("nak", "unplug")
    assert stage.trigger.count() == stage.wires.fired == fired
    assert not stage.trigger.status().estop_pressed
    assert stage.trigger.pulse(0.001) == fired + 1
    assert stage.open_gates() == set()


@pytest.mark.parametrize("request_word", PROJECTORS)
@pytest.mark.parametrize("kind", WIRE)
def test_projector_controller(start, kind, request_word):
    stage = start(Fault("projectors", kind, 0, request=request_word, seconds=LATE_S))
    operation, call = PROJECTORS[request_word]
    fails(kind, "projector controller", operation, call, stage)
    if kind == "unplug":
        until(lambda: stage.plugged("projectors"))
    stage.projectors.off()
    assert stage.projectors.is_dark()
    stage.projectors.load_sequence(ROWS)
    assert stage.projectors.position() == 0


@pytest.mark.parametrize("kind", WIRE)
def test_go_that_fails_is_ended_by_stop(start, kind):
    stage = start(Fault("trigger", kind, 0, request="GO", seconds=LATE_S))
    stage.trigger.load_table([LONG], 30.0)
    fails(kind, "trigger box", "starting the table", lambda s: s.trigger.go(), stage)
    if kind == "unplug":
        until(lambda: stage.plugged("trigger"))
    assert stage.trigger.stop() == 0
    assert stage.open_gates() == set()
    assert stage.trigger.progress().state in ("idle", "stopped")


@pytest.mark.parametrize("kind", WIRE)
def test_progress_that_fails_while_the_table_runs(start, kind):
    stage = start(Fault("trigger", kind, 1, request="SEQ?", seconds=LATE_S))
    stage.trigger.load_table([LONG], 30.0)
    stage.trigger.go()
    until(lambda: stage.wires.fired == 1)
    operation = "reading the table's progress"
    fails(kind, "trigger box", operation, lambda s: s.trigger.progress(), stage)
    if kind == "unplug":
        until(lambda: stage.plugged("trigger"))
    assert stage.trigger.progress().state == "running"
    assert stage.open_gates() == {"L", "P"}
    assert stage.trigger.stop() == 0
    assert stage.open_gates() == set()
    assert stage.projectors.is_dark()


def test_a_box_that_is_unplugged_for_good_closes_its_gates_by_itself(start, slack):
    stage = start(Fault("trigger", "unplug", 1, request="SEQ?", seconds=60.0))
    stage.trigger.load_table([LONG], 0.2 * slack)
    stage.trigger.go()
    until(lambda: stage.wires.fired == 1)
    with pytest.raises(DeviceUnreachable):
        stage.trigger.progress()
    until(lambda: stage.open_gates() == set())
    assert stage.projectors.is_dark()


@pytest.mark.parametrize(
    ("kind", "count", "fired"), [("double", 1, 2), ("dropped", 1, 0), ("uncounted", 0, 1)]
)
def test_counted_and_fired_pulses_can_differ(start, kind, count, fired):
    stage = start(Fault("trigger", kind, 1), Fault("trigger", kind, count + 2))
    assert stage.trigger.pulse(0.001) == count
    assert (stage.trigger.count(), stage.wires.fired) == (count, fired)
    # The same in a table, at its second step.
    stage.trigger.load_table([TableRow(3, "P", 0.0, 0.001, 0.0)], 10.0)
    stage.trigger.go()
    until(lambda: stage.trigger.progress().state == "done")
    assert stage.trigger.progress().steps == 3
    assert stage.wires.fired == 2 * fired + 2
    assert stage.trigger.count() == 2 * count + 2


def test_a_trigger_that_comes_after_its_deadline_is_counted_later(start):
    stage = start(Fault("trigger", "late_trigger", 1, seconds=LATE_S))
    with pytest.raises(DeviceTimeout, match="firing the cameras: expected a line within"):
        stage.trigger.pulse(0.001)
    assert stage.wires.fired == 0
    assert stage.trigger.count() == 1  # it fired meanwhile; nobody may take it for the next
    assert stage.trigger.pulse(0.001) == 2
