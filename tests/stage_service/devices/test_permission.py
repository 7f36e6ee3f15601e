"""Permissions to light, and the standstill that ends them."""

from __future__ import annotations

import threading

import pytest
from waiting import until

from stage_service.devices.permission import NotPermitted, Permission, lighting
from stage_service.devices.standstill import Standstill
from stage_service.records.clock import ClockWatch


class Boot:
    """A clock of seconds since the machine started, set by hand."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def permitted(permission: Permission) -> bool:
    try:
        with permission.used(), lighting("lamp 3 on"):
            return True
    except NotPermitted:
        return False


def test_light_needs_a_permission_that_is_live_and_of_this_thread():
    run = Permission("capture a-1")
    assert not permitted(run)
    run.grant()
    assert permitted(run)
    with pytest.raises(NotPermitted, match="no permission"), lighting("lamp 3 on"):
        pass
    other = []
    with run.used():
        thread = threading.Thread(target=lambda: other.append(permitted(Permission("another"))))
        thread.start()
        thread.join()
    assert other == [False]


def test_a_pause_is_undone_by_a_grant_and_a_revocation_by_nothing():
    run = Permission.granted("capture a-1")
    run.suspend("paused by Ada")
    assert not permitted(run)
    run.lapse("stood still")  # suspended: a person grants it anew anyway
    run.grant()
    assert permitted(run)
    run.revoke("blackout by Eve")
    run.suspend("late")
    with pytest.raises(NotPermitted, match="blackout by Eve"):
        run.grant()
    assert not permitted(run)


def test_a_blackout_waits_for_the_command_under_way_but_not_for_one_that_hangs():
    run, entered, leave = Permission.granted("a-1"), threading.Event(), threading.Event()

    def hang() -> None:
        with run.used(), lighting("lamp 3 on"):
            entered.set()
            leave.wait(60)

    thread = threading.Thread(target=hang)
    thread.start()
    assert entered.wait(60)
    run.revoke("blackout")
    with run.no_light(0.01):
        assert thread.is_alive()
    leave.set()
    with run.no_light(60):
        until(lambda: not thread.is_alive())
    thread.join()


def test_a_standstill_is_found_by_the_watch_and_by_the_next_lighting():
    """The second is the first to run again, as after a machine's sleep."""
    clock, found = Boot(), list[str]()
    still = Standstill(1e6, found.append, clock)  # its own thread looks in 70 hours
    with still:
        clock.now += 1e6
        still.check()
        assert found == []
        clock.now += 1.0
        still.check()
    assert len(found) == 1
    assert "longer than watchdog_s = 1e+06" in found[0]
    clock, found = Boot(), []
    with Standstill(0.02, found.append, clock):
        clock.now += 0.021
        until(lambda: found)
        assert "0.021 s" in found[0]


def test_a_permission_lapses_with_a_standstill(monkeypatch):
    clock = Boot()
    monkeypatch.setattr("stage_service.devices.standstill.boot_seconds", clock)
    run = Permission.granted("capture a-1")
    run._standstill = Standstill(1.0, run.lapse, clock)
    assert permitted(run)
    clock.now += 1.5
    assert not permitted(run)
    with pytest.raises(NotPermitted, match=r"stood still for 1\.5 s"):
        run.grant()


@pytest.mark.parametrize(("wall", "jump"), [(-9000.0, -9000.0), (1.9, None), (3600.0, 3600.0)])
def test_a_clock_that_was_set_is_noticed_once(monkeypatch, wall, jump):
    clock = Boot()
    monkeypatch.setattr("stage_service.records.clock.wall_seconds", lambda: clock.now)
    monkeypatch.setattr("stage_service.records.clock.time.monotonic", lambda: 100.0)
    watch = ClockWatch()
    assert watch.jump() is None
    clock.now += wall
    assert watch.jump() == jump
    assert watch.jump() is None
