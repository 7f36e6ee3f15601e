"""A table of the trigger box over the whole simulated stage: what each pulse saw."""

from __future__ import annotations

import numpy as np
import pytest
from waiting import until

from simulators.peers.faults import Fault, Faults
from simulators.peers.lamps import Lamps
from simulators.peers.trigger_box import SimulatedTriggerBox
from simulators.world import World


@pytest.fixture
def stage(tiny_rig):
    """`stage(*faults)`: a world whose pulses are kept in `world.shots`, and its trigger box."""
    running = []

    def begin(*faults):
        shots = []

        def make(camera, shot, exposure):
            shots.append(shot)
            return np.zeros((16, 16, 3), np.uint16)

        used = Faults(faults)
        world = World(tiny_rig, Lamps(5), used, make)
        world.shots = shots
        world.arm("cam_a", 0.01)
        box = SimulatedTriggerBox(world, used)
        running.append((box, world))
        return world, box

    yield begin
    for box, world in running:
        box.stop()
        world.stop()


def run(world, box, *rows):
    lines = [f"TABLE {len(rows)}", *(f"ROW {i} {row}" for i, row in enumerate(rows)), "ARM", "GO"]
    for line in lines:
        assert box.reply(line).startswith("OK")
    until(lambda: "running" not in box.reply("SEQ?"))
    said = box.reply("SEQ?")
    while (frame := world.oldest("cam_a")) is not None:
        frame.counts.result(60)
        world.take("cam_a", frame)
    return said


def sequence(world, *entries):
    lines = [f"SEQ {len(entries)}", *(f"ENTRY {i} {e}" for i, e in enumerate(entries)), "ARM"]
    for line in lines:
        assert world.projectors.reply(line).startswith("OK")


def test_lamps_and_rows_are_lit_while_their_gate_is_open(stage):
    world, box = stage()
    world.lamps.load(0, [1, 65535, 4, 32768, 0, 0])
    assert world.lamps.arm(3)
    sequence(world, "LINE proj 7 -2 2 500", "ON 9")
    said = run(world, box, "2 L 0 1000 0", "1 LP 0 1000 0", "2 P 0 1000 0", "1 - 0 1000 0")
    assert said == "SEQ done 6 6 -"
    lit = [(list(np.flatnonzero(s.power)), s.show.level, s.show.row) for s in world.shots]
    assert lit == [([0], 0, 0), ([3], 0, 0), ([], 500, 7), ([], 500, 5), ([], 9, 0), ([], 0, 0)]
    assert world.shots[1].power[3] == pytest.approx(32768 / 65535)
    assert world.lamps.sequence() == (3, 3)
    assert world.projectors.reply("SEQ?") == "SEQ armed 3"
    assert not world.lamps.power().any()
    assert world.projectors.show.level == 0


def test_a_tracking_pattern_moves_the_subject_as_a_tracking_exposure_does(stage):
    world, box = stage()
    sequence(world, "ON 9", "LINE proj 0 1 2 9", "ON 9", "LINE proj 2 1 2 9", "ON 9", "ON 9")
    assert run(world, box, "8 P 0 1000 0").startswith("SEQ done 8")
    assert [shot.pose for shot in world.shots] == [0, 0, 0, 1, 1, 1, 2, 2]


def test_doubled_and_dropped_pulses_of_a_table(stage):
    world, box = stage(Fault("trigger", "double", 2), Fault("trigger", "dropped", 4))
    sequence(world, "LINE proj 0 1 5 9")
    assert run(world, box, "5 P 0 1000 0") == "SEQ done 5 5 -"
    assert [(shot.pulse, shot.show.row) for shot in world.shots] == [
        (1, 0),
        (2, 1),
        (2, 1),
        (3, 2),
        (5, 4),
    ]


def test_the_emergency_stop_ends_the_table_at_its_pulse(stage):
    world, box = stage(Fault("trigger", "estop", 2))
    world.lamps.load(0, [1, 65535] * 3)
    assert world.lamps.arm(3)
    assert run(world, box, "3 L 0 1000 0") == "SEQ stopped 1 2 estop"
    assert not world.lamps.power().any()


def test_a_projector_that_stays_blank_is_noticed_before_the_pulse(stage):
    world, box = stage(Fault("projectors", "blank", 2))
    sequence(world, "LINE proj 0 1 5 9")
    assert run(world, box, "5 P 0 1000 0") == "SEQ stopped 2 2 no-pattern"
    assert len(world.shots) == 2
