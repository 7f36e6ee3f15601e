"""What a run says of itself, by a clock of our own."""

from __future__ import annotations

from reconstruction import Step
from stage_service.acquisition.progress import RunProgress
from stage_service.acquisition.states import Progress

STEPS = [
    *(Step(i, "olat", 0.01, light=f"light_{i:03d}") for i in range(10)),
    *(Step(i, "scanline", 0.01, projector="left", row=i) for i in range(10, 30)),
]


class Watch:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_time_left_is_that_of_the_steps_that_were_measured():
    clock, reported = Watch(), list[Progress]()
    run = RunProgress(STEPS, {"a": 0, "b": 0}, reported.append, clock)
    for step in STEPS[:10]:
        run.begin(step)
        clock.now += 60.0 if step.index == 0 else 2.0  # the first waits for a camera to warm up
        run.responded("a")
        assert (reported[-1].here, reported[-1].frames["a"]) == (1, step.index)
        run.responded("b")
        run.arrived("a")
        run.arrived("b")
        run.done(step)
        if step.index < 2:
            assert run.now().seconds_left is None, "two steps tell nothing"
        elif step.index == 4:
            assert run.now().seconds_left == 25 * 2.0
            assert run.now().light == "light_004"
    assert run.now().seconds_left == 20 * 2.0, "no row was measured yet: as long as the lights"
    for step in STEPS[10:13]:
        run.begin(step)
        clock.now += 0.5
        run.done(step)
    now = run.now()
    assert (now.step, now.kind, now.row, now.frames) == (13, "scanline", 12, {"a": 10, "b": 10})
    assert now.here == 0
    assert now.seconds_left == 17 * 0.5
    assert len(reported) >= 13


def test_progress_within_the_interval_is_reported_once_while_the_run_waits():
    clock, reported = Watch(), list[Progress]()
    run = RunProgress(STEPS, dict.fromkeys("abcd", 0), reported.append, clock)
    run.begin(STEPS[0])
    for camera in "abc":
        run.responded(camera)
    assert [now.here for now in reported] == [0]
    clock.now += 1.0
    for _ in range(9):
        run.waiting({})
    assert [now.here for now in reported] == [0, 3]


def test_a_run_of_the_box_is_as_far_as_its_slowest_camera():
    clock, reported = Watch(), list[Progress]()
    run = RunProgress(STEPS, {"a": 3, "b": 3}, reported.append, clock)
    run.begin_run(STEPS[:10])
    clock.now += 30.0
    for _ in range(5):
        run.came("a")
    assert (run.now().step, run.now().by_box, run.now().frames) == (0, True, {"a": 8, "b": 3})
    for _ in range(3):
        run.came("b")
        clock.now += 1.0
    now = run.now()
    assert (now.step, now.light) == (3, "light_003")
    assert now.seconds_left == 1.5 * 7 + 1.5 * 20, "3 s for the two frames after the first"
    run.end_run({"a": 5, "b": 3})
    assert run.now().frames == {"a": 8, "b": 6}
    assert not run.now().by_box
