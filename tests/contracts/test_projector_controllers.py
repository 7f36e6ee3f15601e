"""One contract for every projector controller: the simulated one, and version 1."""

from __future__ import annotations

import pytest
from waiting import until

from stage_service.devices.errors import DeviceError
from stage_service.devices.heartbeat import Heartbeat
from stage_service.devices.projectors.interface import Pattern
from stage_service.devices.projectors.serial_controller import SerialProjectorController
from stage_service.devices.trigger.interface import TableRow


class First:
    """A controller of version 1: it shows, and has neither sequences nor a watchdog."""

    def __init__(self, serve):
        self.show = "OFF"
        self.driver = SerialProjectorController(serve(self.reply), ("left", "right"))
        self.driver.connect()

    def reply(self, line):
        words = line.split()
        if line == "ID?":
            return "HAIRSTAGE-PROJECTORS left,right"
        if line == "SHOW?":
            return f"SHOW {self.show}"
        if words[0] not in ("LINE", "ON", "OFF"):
            return "ERR 1 unknown command"
        if words[0] == "LINE" and words[1] not in ("left", "right"):
            return "ERR 2 unknown projector"
        self.show = line
        return f"OK {line}"


@pytest.fixture
def stage(serial_stage):
    return serial_stage()


@pytest.fixture(params=["version 1", "simulator"])
def driver(request):
    if request.param == "simulator":
        yield request.getfixturevalue("serial_stage")().projectors
        return
    one = First(request.getfixturevalue("serve")).driver
    yield one
    one.close()


def rows(*numbers, projector="left", level=1.0):
    return [Pattern(level, projector, row) for row in numbers]


def test_it_shows_and_goes_dark(driver):
    assert driver.names == ("left", "right")
    assert driver.capabilities.reads_back
    assert driver.is_dark()
    driver.line("left", 11, 0.5)
    assert not driver.is_dark()
    driver.all_on(1.0)
    assert not driver.is_dark()
    driver.heartbeat()
    assert not driver.is_dark()
    driver.off()
    assert driver.is_dark()
    with pytest.raises(DeviceError, match="ERR 2"):
        driver.line("nobody", 0, 1.0)
    with pytest.raises(ValueError, match="level is 0 to 1"):
        driver.all_on(1.1)


def test_version_1_has_neither_sequences_nor_a_dead_man(serve):
    driver = First(serve).driver
    assert driver.capabilities.table == 0
    assert not driver.capabilities.dead_man
    with pytest.raises(DeviceError, match=r"expected 1 to 0 entries.*step by software"):
        driver.load_sequence(rows(1))
    with pytest.raises(DeviceError, match=r"setting the watchdog: .*ERR 1"):
        driver.set_watchdog(1.0)
    driver.close()


@pytest.mark.parametrize(
    ("patterns", "entries"),
    [
        (rows(*range(768)), ["LINE left 0 1 768 65535"]),
        (rows(5, 5, 5), ["LINE left 5 0 3 65535"]),
        (rows(9, 7, 5, 6, 7), ["LINE left 9 -2 3 65535", "LINE left 6 1 2 65535"]),
        (rows(3) + rows(4, projector="right"), ["LINE left 3 1 1 65535", "LINE right 4 1 1 65535"]),
        (rows(3) + rows(4, level=0.5), ["LINE left 3 1 1 65535", "LINE left 4 1 1 32768"]),
        ([Pattern(0.5), Pattern(0.5)], ["ON 32768", "ON 32768"]),
        (
            [Pattern(0.5), *rows(0, 1, 2), Pattern(0.5), *rows(3, 4)],
            ["ON 32768", "LINE left 0 1 3 65535", "ON 32768", "LINE left 3 1 2 65535"],
        ),
    ],
)
def test_rows_travel_in_runs_and_are_shown_one_by_one(stage, patterns, entries):
    stage.projectors.load_sequence(patterns)
    sent = [line.split(" ", 3)[3] for line in stage.requests if " ENTRY " in line]
    assert sent == entries
    for i, pattern in enumerate(patterns):
        assert stage.projectors.position() == i
        assert stage.projectors.is_dark()
        stage.controller.gate(True)
        assert stage.controller.trigger_out
        shown = stage.controller.show
        level = round(pattern.level * 65535)
        assert (shown.level, shown.projector, shown.row) == (level, pattern.projector, pattern.row)
        assert not stage.projectors.is_dark()
        stage.controller.gate(False)
        assert not stage.controller.trigger_out
    assert stage.projectors.position() == len(patterns)
    stage.controller.gate(True)  # nothing is left to show, and the box hears of no pattern
    assert not stage.controller.trigger_out
    assert stage.projectors.is_dark()


@pytest.mark.parametrize("leave", ["off", "all_on", "line"])
def test_a_command_leaves_the_sequence(stage, leave):
    driver = stage.projectors
    driver.load_sequence(rows(1, 2))
    arguments = {"off": (), "all_on": (1.0,), "line": ("right", 7, 1.0)}[leave]
    getattr(driver, leave)(*arguments)
    stage.controller.gate(True)
    assert stage.controller.show.row == (7 if leave == "line" else 0)
    with pytest.raises(DeviceError, match="expected an armed sequence, received idle, after 0"):
        driver.position()


@pytest.mark.parametrize(
    ("patterns", "said"),
    [
        (rows(768), "entry 0 of the sequence: .*ERR 2 row"),
        (rows(0) + rows(1, projector="middle"), "entry 1 .*ERR 2 unknown projector middle"),
        ([], "received 0 entries"),
        ([Pattern(1.0)] * 4097, "expected 1 to 4096 entries"),
    ],
)
def test_a_sequence_that_cannot_be_shown_is_refused_dark(stage, patterns, said):
    with pytest.raises(DeviceError, match=said):
        stage.projectors.load_sequence(patterns)
    stage.controller.gate(True)
    assert stage.projectors.is_dark()


@pytest.mark.parametrize("by", ["a command", "the gate"])
def test_lit_projectors_go_dark_without_requests(stage, by):
    driver, controller = stage.projectors, stage.controller
    driver.set_watchdog(0.1)
    if by == "a command":
        driver.all_on(1.0)
    else:
        driver.load_sequence(rows(1, 2))
        controller.gate(True)
    stage.now += 0.099
    assert controller.show.level > 0
    stage.now += 0.002
    assert controller.show.level == 0
    controller.gate(False)
    controller.gate(True)
    assert not controller.trigger_out
    assert driver.is_dark()
    with pytest.raises(DeviceError, match=r"received watchdog, after 0 .*no request"):
        driver.position()


def test_short_flashes_do_not_keep_an_armed_sequence_alive(stage):
    stage.projectors.set_watchdog(0.1)
    stage.projectors.load_sequence(rows(*[1] * 100))

    def flash():
        stage.controller.gate(True)
        up = stage.controller.trigger_out
        stage.controller.gate(False)
        return up

    assert flash()
    stage.now += 0.099
    assert flash()
    stage.now += 0.002
    assert not flash()
    with pytest.raises(DeviceError, match="received watchdog"):
        stage.projectors.position()


def test_a_heartbeat_keeps_them_lit(stage):
    driver = stage.projectors
    driver.set_watchdog(0.25)
    driver.all_on(1.0)
    with Heartbeat(driver, 0.02) as heartbeat:
        for _ in range(3):
            stage.now += 0.2
            beats = stage.requests.count("projectors SHOW?") + 2  # the second: one was answered
            until(lambda: stage.requests.count("projectors SHOW?") >= beats)  # noqa: B023
        heartbeat.check()
    assert not driver.is_dark()
    with pytest.raises(ValueError, match="a watchdog time is"):
        driver.set_watchdog(0.0999)


def test_box_and_projectors_keep_step(stage):
    patterns = [Pattern(0.5), *rows(0, 1, 2), Pattern(0.5), *rows(3, 4)]
    stage.projectors.load_sequence(patterns)
    stage.trigger.load_table([TableRow(7, "P", 0.0, 0.002, 0.004)], 10.0)
    stage.trigger.go()
    until(lambda: stage.trigger.progress().state == "done")
    assert stage.trigger.progress().steps == stage.projectors.position() == 7
    assert stage.projectors.is_dark()
    # One step more than patterns: the box stops instead of shooting a dark frame.
    stage.trigger.load_table([TableRow(1, "P", 0.0, 0.002, 0.0)], 10.0)
    stage.trigger.go()
    until(lambda: stage.trigger.progress().state == "stopped")
    assert stage.trigger.progress().reason == "no-pattern"
    assert stage.trigger.count() == 7
