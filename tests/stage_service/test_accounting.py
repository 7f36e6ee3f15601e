"""Pulses against frames."""

from __future__ import annotations

import pytest

from stage_service.accounting import FrameAccount, PulseAccount
from stage_service.devices.errors import IndexShift


def account(last: int | None = None, unanswered: int = 0) -> FrameAccount:
    result = FrameAccount("cam_00", 65535)
    result.last, result.unanswered = last, unanswered
    return result


@pytest.mark.parametrize(
    ("last", "unanswered", "block_id"),
    [
        (None, 0, 1),
        (7, 0, 8),
        (65534, 0, 65535),
        (65535, 0, 1),
        (7, 2, 8),  # the camera missed two pulses
        (7, 2, 10),  # two frames were lost on the way
        (65534, 2, 2),
    ],
)
def test_block_ids_that_fit_the_pulses(last, unanswered, block_id):
    one = account(last, unanswered)
    one.arrived(block_id)
    assert (one.last, one.unanswered) == (block_id, 0)


@pytest.mark.parametrize(
    ("last", "unanswered", "block_id", "expected"),
    [
        (None, 0, 2, "block id 1"),
        (7, 0, 7, "block id 8"),  # repeated
        (7, 0, 9, "block id 8"),  # a frame that no pulse of ours asked for
        (7, 1, 10, "block id 8 to 9"),
        (65535, 0, 2, "block id 1"),
        (7, 0, 0, "block id 8"),
        (65534, 0, 65536, "block id 65535"),
    ],
)
def test_block_ids_that_do_not_fit_are_named(last, unanswered, block_id, expected):
    with pytest.raises(IndexShift) as error:
        account(last, unanswered).arrived(block_id)
    assert error.value.expected == expected
    assert error.value.received == f"block id {block_id}"


def test_a_late_frame_needs_an_unanswered_pulse():
    one = account(7, 2)
    one.late(8)
    assert one.unanswered == 1
    one.arrived(10)
    with pytest.raises(IndexShift, match="no frame beside those of our pulses"):
        one.late(11)


def test_pulses_count_one_by_one():
    box = PulseAccount("trigger box")
    box.fired(1)
    box.fired(2)
    with pytest.raises(IndexShift, match="expected pulse 3, received pulse 4"):
        box.fired(4)
