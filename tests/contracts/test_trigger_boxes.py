"""One contract for every trigger box: the simulated one, the compiled firmware, version 1."""

from __future__ import annotations

import math
import threading

import pytest
from waiting import until

from simulators.peers.faults import Fault
from stage_service.devices.errors import DeviceError, SafetyRefusal
from stage_service.devices.trigger.interface import TableProgress, TableRow, TriggerStatus
from stage_service.devices.trigger.serial_box import SerialTriggerBox

WATCHDOG_S = 30.0
LONG = TableRow(1, "L", 0.0, 9.0, 0.0)


class Simulated:
    """The simulated box, with what tests do to it and see of it."""

    def __init__(self, stage):
        self.stage, self.driver, self.edges = stage, stage.trigger, stage.wires.edges

    def press(self, what):
        self.stage.faults.add(Fault("trigger", what, 0))

    def patterns(self, count):
        for line in ("SEQ 1", f"ENTRY 0 LINE left 0 1 {count} 9", "ARM", "WATCHDOG 60000"):
            assert self.stage.controller.reply(line).startswith("OK")

    def no_patterns(self):
        self.stage.faults.add(Fault("projectors", "blank", 0))


class Compiled:
    """The firmware on this machine."""

    def __init__(self, box):
        self.box, self.driver, self.edges = box, box.trigger, box.edges

    def press(self, what):
        self.box.steer({"interlock": "I", "estop": "E"}[what])

    def patterns(self, count):
        self.box.steer("P")

    def no_patterns(self):
        self.box.steer("p")


class First:
    """A box of version 1: it counts, and has no table."""

    def __init__(self, serve):
        self.count = 0
        self.driver = SerialTriggerBox(serve(self.reply))
        self.driver.connect()

    def reply(self, line):
        words = line.split()
        self.count = {"RESET": 0, "PULSE": self.count + 1}.get(words[0], self.count)
        return {
            "ID?": "HAIRSTAGE-TRIGGER 1",
            "PULSE": f"OK {self.count}",
            "COUNT?": f"COUNT {self.count}",
            "RESET": "OK 0",
            "STATUS?": "STATUS interlock=0 estop=0",
        }.get(words[0], "ERR 1 unknown command")


def start(name, request):
    if name == "version 1":
        return First(request.getfixturevalue("serve"))
    if name == "simulator":
        return Simulated(request.getfixturevalue("serial_stage")())
    return Compiled(request.getfixturevalue("firmware")())


@pytest.fixture(params=["simulator", "firmware"])
def box(request):
    """A box with a table."""
    return start(request.param, request)


@pytest.fixture(params=["version 1", "simulator", "firmware"])
def any_box(request):
    one = start(request.param, request)
    yield one
    one.driver.close()


def running(box, *rows, watchdog_s=WATCHDOG_S):
    box.driver.load_table(rows, watchdog_s)
    box.driver.go()


def closed(box):
    """Whether gates were opened, and all of them closed again."""
    state = {name: up for _, name, up in list(box.edges) if name != "C"}
    return bool(state) and not any(state.values())


def times(box, name, up=True):
    return [t for t, n, u in box.edges if (n, u) == (name, up)]


def test_it_counts_its_pulses(any_box):
    driver = any_box.driver
    driver.reset()
    assert [driver.pulse(1e-6), driver.pulse(0.01), driver.count()] == [1, 2, 2]
    driver.reset()
    assert driver.count() == 0
    assert driver.status() == TriggerStatus(interlock_open=False, estop_pressed=False)
    with pytest.raises(DeviceError, match="ERR 1 unknown command"):
        driver._lines.request("FIRE", "OK", "firing")


@pytest.mark.parametrize("exposure", [0.0, -1.0, 4e-7, 10.001, math.nan, math.inf])
def test_exposures_out_of_range_fire_nothing(any_box, exposure):
    with pytest.raises(ValueError, match="exposure must be 1e-06 to 10 s"):
        any_box.driver.pulse(exposure)
    assert any_box.driver.count() == 0


def test_a_box_without_a_table_reports_it(serve):
    driver = First(serve).driver
    assert driver.table_rows == 0
    with pytest.raises(
        DeviceError, match=r"expected a box that runs tables.*hardware_stepping = false"
    ):
        driver.load_table([LONG], WATCHDOG_S)
    driver.close()


def test_a_table_runs_from_its_first_step_to_its_last(box):
    driver = box.driver
    assert driver.table_rows == 4096
    driver.pulse(0.001)
    box.patterns(3)
    rows = [
        TableRow(1, "L", 0.001, 0.002, 0.005),
        TableRow(2, "LP", 0.003, 0.001, 0.004),
        TableRow(1, "P", 0.0, 1e-6, 0.0),
        TableRow(1, "-", 0.0, 0.0014999, 0.0),
    ]
    driver.load_table(rows, WATCHDOG_S)
    assert driver.progress() == TableProgress("armed", 0, 0, "-")
    driver.go()
    until(lambda: driver.progress().state != "running")
    assert driver.progress() == TableProgress("done", 5, 5, "-")
    assert driver.count() == 6
    until(lambda: len(times(box, "P", False)) == 3)
    order = [(name, up) for _, name, up in box.edges if name != "C"]
    both = {("L", True), ("P", True)}, {("L", False), ("P", False)}
    assert order[:2] == [("L", True), ("L", False)]
    assert [set(order[i : i + 2]) for i in (2, 4, 6, 8)] == [*both, *both]
    assert order[10:] == [("P", True), ("P", False)]


def test_steps_keep_their_times(box):
    steps, settle, exposure, period = 6, 0.006, 0.004, 0.03
    running(box, TableRow(steps, "L", settle, exposure, period))
    until(lambda: box.driver.progress().state == "done")
    until(lambda: len(times(box, "L", False)) == steps)
    opened, fired, shut = times(box, "L"), times(box, "C"), times(box, "L", False)
    assert len(opened) == len(fired) == len(shut) == steps
    # Nothing comes early; how late it comes is this machine's, so it is not asked.
    for i in range(steps):
        assert fired[i] - opened[i] >= settle - 5e-4
        assert shut[i] - fired[i] >= exposure - 5e-4
        assert opened[i] - opened[0] >= i * period - 0.01


def test_a_step_that_takes_longer_than_its_period_is_followed_at_once(box):
    """Not at the next multiple of the period, 20 ms later, nor a period after its own end."""
    running(box, TableRow(5, "L", 0.0, 0.04, 0.03))
    until(lambda: box.driver.progress().state == "done")
    until(lambda: len(times(box, "L", False)) == 5)
    pairs = zip(times(box, "L")[1:], times(box, "L", False)[:-1], strict=True)
    dark = [opened - shut for opened, shut in pairs]
    assert min(dark) >= 0
    assert min(dark) < 0.01  # the others wait for this machine


def test_an_armed_table_can_be_run_again(box):
    running(box, TableRow(2, "L", 0.0, 0.001, 0.0))
    until(lambda: box.driver.progress().state == "done")
    with pytest.raises(DeviceError, match=r"starting the table: .*ERR 4"):
        box.driver.go()
    running(box, TableRow(3, "-", 0.0, 0.001, 0.0))
    until(lambda: box.driver.progress().state == "done")
    assert box.driver.progress().steps == 3
    assert box.driver.count() == 5


def test_stop_closes_the_gates_in_mid_step(box):
    running(box, TableRow(2, "L", 0.0, 0.001, 0.0), LONG)
    until(lambda: box.driver.progress().pulses == 3)
    until(lambda: len(times(box, "L")) == 3)  # edges come by their own way, later than replies
    assert not closed(box)
    assert box.driver.stop() == 2
    until(lambda: closed(box))
    assert box.driver.progress() == TableProgress("stopped", 2, 3, "stop")
    assert box.driver.stop() == 2
    box.driver.pulse(0.001)  # nothing runs any more


def test_stop_takes_an_armed_table_back(box):
    box.driver.load_table([LONG], WATCHDOG_S)
    assert box.driver.stop() == 0
    assert box.driver.progress().state == "idle"
    with pytest.raises(DeviceError, match="ERR 4"):
        box.driver.go()


def test_a_running_table_is_not_disturbed(box):
    running(box, LONG)
    until(lambda: box.driver.progress().pulses == 1)
    for call in (
        lambda: box.driver.pulse(0.001),
        box.driver.reset,
        lambda: box.driver.load_table([LONG], WATCHDOG_S),
        box.driver.go,
    ):
        with pytest.raises(DeviceError, match="ERR 4"):
            call()
    assert box.driver.count() == 1
    until(lambda: len(times(box, "L")) == 1)
    assert not closed(box)
    box.driver.stop()


def test_the_table_stops_without_requests(box, slack):
    running(box, LONG, watchdog_s=0.1 * slack)
    until(lambda: closed(box))
    assert box.driver.progress() == TableProgress("stopped", 0, 1, "watchdog")


def test_noise_does_not_feed_the_watchdog(box):
    running(box, LONG, watchdog_s=0.2)
    lines, ended = box.driver._lines, threading.Event()

    def babble():
        while not ended.wait(0.02):
            lines._port.write(b"\xff?\n")
            lines._port.reset_input_buffer()

    babbler = threading.Thread(target=babble)
    babbler.start()
    until(lambda: closed(box))
    ended.set()
    babbler.join()
    box.driver.connect()
    assert box.driver.progress().reason == "watchdog"


@pytest.mark.parametrize("what", ["interlock", "estop"])
def test_a_safety_input_stops_the_table_and_refuses_the_next(box, what):
    running(box, LONG)
    until(lambda: box.driver.progress().pulses == 1)
    box.press(what)
    until(lambda: closed(box))
    assert box.driver.progress() == TableProgress("stopped", 0, 1, what)
    status = box.driver.status()
    assert (status.interlock_open, status.estop_pressed) == (what == "interlock", what == "estop")
    with pytest.raises(SafetyRefusal, match="firing the cameras"):
        box.driver.pulse(0.001)
    with pytest.raises(SafetyRefusal, match="starting the table"):
        running(box, LONG)
    assert box.driver.count() == 1


def test_without_a_pattern_no_camera_fires(box):
    box.no_patterns()
    running(box, TableRow(1, "LP", 0.0, 0.001, 0.0))
    until(lambda: closed(box))
    assert box.driver.progress() == TableProgress("stopped", 0, 0, "no-pattern")
    assert box.driver.count() == 0


@pytest.mark.parametrize(
    ("row", "said"),
    [
        (TableRow(1, "L", 1.1, 0.1, 0.0), "settle must be 0 to 1 s, got 1.1"),
        (TableRow(1, "L", -1e-6, 0.1, 0.0), "settle must be"),
        (TableRow(1, "L", 0.0, 0.0, 0.0), "exposure must be"),
        (TableRow(1, "L", 0.0, 0.1, 60.1), "period must be 0 to 60 s"),
        (TableRow(0, "L", 0.0, 0.1, 0.0), "repeated 1 or more times, got 0"),
        (TableRow(1, "X", 0.0, 0.1, 0.0), "gates must be"),
    ],
)
def test_rows_out_of_range_reach_no_device(box, row, said):
    with pytest.raises(ValueError, match=said):
        box.driver.load_table([row], WATCHDOG_S)
    assert box.driver.progress().state == "idle"


def test_rows_alike_are_joined_and_more_than_fit_are_refused(box):
    alike = TableRow(700_000, "L", 0.001, 0.02, 0.05)
    box.driver.load_table([alike] * 4096, WATCHDOG_S)  # 2.9e9 steps in 2868 rows
    rows = [TableRow(1, "L", 0.0, 0.001 + (i % 2) * 0.001, 0.0) for i in range(4097)]
    with pytest.raises(DeviceError, match="expected 1 to 4096 rows"):
        box.driver.load_table(rows, WATCHDOG_S)
    with pytest.raises(DeviceError, match="received 0 rows"):
        box.driver.load_table([], WATCHDOG_S)
    with pytest.raises(ValueError, match=r"a watchdog time is 0.1 to 60 s"):
        box.driver.load_table([LONG], 0.05)


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("TABLE 0", 2),
        ("TABLE 4097", 2),
        ("TABLE -1", 2),
        ("ROW 0 1 L 0 1 0", 4),
        ("ARM", 4),
        ("GO", 4),
        ("WATCHDOG 99", 2),
        ("WATCHDOG 60001", 2),
        ("ID?  ", 1),
        ("go", 1),
        ("", 1),
        ("X" * 97, 1),
        ("PULSE 99999999999999999999", 2),
    ],
)
def test_bad_requests_are_refused_in_one_line(box, line, code):
    with pytest.raises(DeviceError, match=f"'ERR {code} "):
        box.driver._lines.request(line, "OK", "trying")
    assert box.driver.progress().state == "idle"


@pytest.mark.parametrize(
    ("row", "code"),
    [
        ("ROW 1 1 L 0 1 0", 2),
        ("ROW 0 0 L 0 1 0", 2),
        ("ROW 0 1000001 L 0 1 0", 2),
        ("ROW 0 1 PL 0 1 0", 2),
        ("ROW 0 1 L 1000001 1 0", 2),
        ("ROW 0 1 L 0 0 0", 2),
        ("ROW 0 1 L 0 1 60000001", 2),
        ("ROW 0 1 L 0 1", 1),
        ("ROW 0 1 L 0 1 0 0", 1),
    ],
)
def test_bad_rows_are_refused_and_the_table_can_go_on(box, row, code):
    send_line = box.driver._lines.request
    send_line("TABLE 1", "OK TABLE 1", "beginning")
    with pytest.raises(DeviceError, match=f"'ERR {code} "):
        send_line(row, "OK", "trying")
    with pytest.raises(DeviceError, match="'ERR 4 "):
        send_line("ARM", "OK", "trying")
    send_line("ROW 0 007 L 0 1 0", "OK ROW 0", "going on")
    # The checksum is of the row as the box holds it.
    send_line("ARM", "OK ARM 7 d029b3ca", "arming")
