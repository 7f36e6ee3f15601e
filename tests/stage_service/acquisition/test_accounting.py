"""Pulses against frames."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stage_service.acquisition.accounting import FrameAccount, PulseAccount
from stage_service.devices.errors import IndexShift


def account(last: int | None = None, without_frame: int = 0) -> FrameAccount:
    result = FrameAccount("cam_00", 65535)
    result.last, result.without_frame = last, without_frame
    return result


@pytest.mark.parametrize(
    ("last", "without_frame", "block_id"),
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
def test_block_ids_that_fit_the_pulses(last, without_frame, block_id):
    one = account(last, without_frame)
    one.arrived(block_id)
    assert (one.last, one.without_frame) == (block_id, 0)


@pytest.mark.parametrize(
    ("last", "without_frame", "block_id", "expected"),
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
def test_block_ids_that_do_not_fit_are_named(last, without_frame, block_id, expected):
    with pytest.raises(IndexShift) as error:
        account(last, without_frame).arrived(block_id)
    assert error.value.expected == expected
    assert error.value.received == f"block id {block_id}"


def test_a_late_frame_needs_an_unanswered_pulse():
    one = account(7, 2)
    one.late(8)
    assert one.without_frame == 1
    one.arrived(10)
    with pytest.raises(IndexShift, match="no frame beside those of our pulses"):
        one.late(11)


def test_pulses_count_one_by_one():
    box = PulseAccount("trigger box")
    box.fired(1)
    box.fired(2)
    with pytest.raises(IndexShift, match="expected pulse 3, received pulse 4"):
        box.fired(4)


WRAP = 40
"""A camera that wraps soon, so that the tests see it."""


@given(
    fates=st.lists(st.sampled_from("ooooolm"), min_size=1, max_size=30), last=st.integers(0, WRAP)
)
def test_frames_are_placed_rightly_or_not_at_all(fates, last):
    """Each pulse's frame came (o), was lost on the way (l), or the camera missed the pulse (m)."""
    one = account(last or None)
    one.wrap = WRAP
    block, ids, true = last, [], []
    for pulse, fate in enumerate(fates):
        if fate == "m":
            continue
        block = block % WRAP + 1
        if fate == "o":
            ids.append(block)
            true.append(pulse)
    places = one.place(ids, len(fates))
    assert places in (true, None)
    if set(fates) <= {"o", "l"} and fates[-1] == "o":
        assert places == true


def test_a_whole_run_is_placed_over_a_wrap():
    one = account(last=65530)
    assert one.place([65531 + i if i < 5 else i - 4 for i in range(8)], 8) == [*range(8)]
    assert (one.last, one.without_frame) == (3, 0)


def test_a_lost_frame_leaves_a_gap_that_shows_its_place():
    assert account(last=4).place([5, 6, 8], 4) == [0, 1, 3]


def test_an_over_trigger_without_a_gap_is_not_placed():
    assert account(last=0).place([1, 2, 3, 4, 5], 6) is None


@pytest.mark.parametrize("ids", [[5, 5, 6], [5, 6, 7, 8], [5, 7, 6], [9, 10, 11]])
def test_runs_with_repeated_surplus_or_foreign_frames_are_refused(ids):
    with pytest.raises(IndexShift, match="cam_00"):
        account(last=4).place(ids, 3)


def test_a_run_without_any_frame_is_all_missing():
    one = account(last=4)
    assert one.place([], 3) == []
    assert one.without_frame == 3


@given(
    offset=st.floats(-1e6, 1e6),
    drift=st.floats(-1e-4, 1e-4),
    jitter=st.lists(st.floats(0, 0.05), min_size=6, max_size=6),
)
def test_time_stamps_identify_a_frame_of_an_earlier_pulse(offset, drift, jitter):
    one = FrameAccount("cam_00", 65535)
    one.armed()
    now, stamps = 1000.0, []
    for late in jitter:
        stamps.append((1 + drift) * now + offset)
        one.timed(stamps[-1], now - 1e-4, now + late)
        now += 0.06
    with pytest.raises(IndexShift, match="made by the newest pulse"):
        one.timed(stamps[-1], now - 1e-4, now + jitter[0])


def test_frames_behind_the_newest_are_named():
    with pytest.raises(IndexShift, match="received 1 behind block id 8"):
        account(last=7).arrived(8, left=1)


def test_a_block_id_out_of_range_is_refused_anywhere_in_a_run():
    with pytest.raises(IndexShift):
        account(last=65533).place([65534, 65535, 0], 3)
