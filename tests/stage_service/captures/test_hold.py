"""The hold of the queue: which word releases it, and what is kept of its reasons."""

from __future__ import annotations

import threading

import pytest
from waiting import until

from stage_service.captures import capture_queue
from stage_service.captures.capture_queue import CaptureQueue
from stage_service.captures.hold import MOST_REASONS, Hold, HoldChanged
from stage_service.records.events import EventLog


@pytest.fixture
def hold() -> Hold:
    return Hold(EventLog())


def test_a_service_starts_held_and_the_id_that_was_read_releases_it(hold):
    assert hold.current is not None
    hold.release(hold.current.id)
    assert hold.current is None
    hold.release("anything")  # already released: whoever presses twice has what they wanted


def test_a_reason_that_came_after_the_reading_is_not_released(hold):
    read = hold.current.id
    hold.set("blackout by Ada")
    with pytest.raises(HoldChanged, match="blackout by Ada") as refused:
        hold.release(read)
    assert refused.value.hold == hold.current.id != read
    hold.release(refused.value.hold)
    assert hold.current is None


def test_the_same_button_twice_is_a_new_hold_with_one_reason(hold):
    hold.set("blackout by Ada")
    first = hold.current
    hold.set("blackout by Ada")
    assert hold.current.id != first.id
    whys = [reason.why for reason in hold.current.reasons]
    assert whys.count("blackout by Ada") == 1
    assert whys[1] == "the service started"


def test_reasons_of_the_service_before_follow_those_of_this_start(hold):
    before = Hold(EventLog())
    before.set("abort of capture a-1")
    hold.recall(before.current.reasons)
    assert [r.why for r in hold.current.reasons] == ["the service started", "abort of capture a-1"]
    hold.release(hold.current.id)
    hold.recall(before.current.reasons)  # read from the disk after a person released it
    assert hold.current is None


def test_the_newest_reasons_are_kept_and_can_be_sent(hold):
    for n in range(3 * MOST_REASONS):
        hold.set(f"abort {n} of \udc80")
    assert len(hold.current.reasons) == MOST_REASONS
    assert hold.current.reasons[0].why.startswith("abort 14")
    assert hold.current.text.encode().startswith(b"abort 14 of ")


def test_a_standstill_while_the_disk_is_full_holds_the_queue(tmp_path, monkeypatch):
    """The queue's thread then pauses between two attempts to save; the process is stopped there."""
    hold, boot, failed = Hold(EventLog()), [100.0], threading.Event()
    hold.release(hold.current.id)

    class Stopped(threading.Condition):
        def wait_for(self, *args):
            if failed.is_set() and boot[0] == 100.0:
                boot[0] += 60.0
            return super().wait_for(*args)

    def full(self):
        failed.set()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(capture_queue, "boot_seconds", lambda: boot[0])
    monkeypatch.setattr(capture_queue, "POLL_S", 0.01)
    monkeypatch.setattr(CaptureQueue, "_save", full)
    queue = CaptureQueue(tmp_path / "queue.json", EventLog(), lambda _: "", lambda: None, hold)
    queue._changed, queue._unsaved = Stopped(), True
    queue.start({}, set(), None)
    try:
        until(lambda: hold.current)
    finally:
        queue.close()
    assert hold.current.text.startswith("the service stood still for 60 s")
