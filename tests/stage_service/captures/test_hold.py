"""The hold of the queue: which word releases it, and what is kept of its reasons."""

from __future__ import annotations

import pytest

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
