"""Cell by cell: each condition against each way to put light on, and their order."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import pytest

from stage_service.captures.hold import Held, Reason
from stage_service.captures.latch import Latched, Unsafe
from stage_service.captures.may_light import STALE_S, Busy, Facts, NotNow, Way, check
from stage_service.plan.flash import FlashRate, FlashRefusal
from stage_service.records.lease import Lease, Leased

WAYS: tuple[Way, ...] = ("capture", "snapshot", "continue", "entry", "resume", "queue")
FLASHES = FlashRate(hz=14.0, band="3 to 30 Hz", by_kind={}, needs_consent=True)
NEVER: dict[str, tuple[dict[str, Any], type[Exception], str]] = {
    "closing": ({"closing": True}, NotNow, "closing"),
    "darkening": ({"darkening": True}, NotNow, "being put dark"),
    "revoked": ({"revoked": True}, NotNow, "put dark meanwhile"),
    "stale": ({"stale": STALE_S + 0.1}, NotNow, "30 s passed"),
    "running": ({"running": "a-1"}, Busy, "a-1"),
    "latched": ({"latched": Latched("then", "lamp 3 is lit", True)}, Unsafe, "lamp 3 is lit"),
    "unknown": ({"unknown": True}, NotNow, "send a blackout"),
    "unread": ({"unread": 7}, NotNow, "7 to come"),
    "leased": ({"leased": Lease("Ada", "noon", "-")}, Leased, "Ada steers"),
    "held": (
        {"held": Held(id="1", reasons=(Reason(at="2026-05-03T12:00:00+00:00", why="a stop"),))},
        NotNow,
        "held: a stop, 2026-05-03 12:00:00 UTC",
    ),
    "flashes": (
        {"flashes": FlashRefusal(FLASHES, None, seconds=9.0, slow_seconds=90.0)},
        FlashRefusal,
        "14.0 Hz",
    ),
}
"""Conditions, the most urgent first: facts, error, what its message contains."""
PERMITTED = {
    *(("held", way) for way in WAYS if way != "queue"),  # a person's own word
    *(("unread", way) for way in WAYS if way != "queue"),
    ("running", "resume"),  # it is the run itself
    ("flashes", "resume"),  # it was armed when it started
}
"""The only cells in which a condition does not refuse."""


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("condition", NEVER)
def test_each_condition_refuses_each_way_but_those_permitted(condition, way):
    facts, error, words = NEVER[condition]
    if (condition, way) in PERMITTED:
        check(way, Facts(**facts))
        return
    with pytest.raises(error) as caught:
        check(way, Facts(**facts))
    assert words in str(getattr(caught.value, "problems", caught.value))


@pytest.mark.parametrize("way", WAYS)
def test_nothing_refuses_a_stage_that_is_dark_free_and_known(way):
    check(way, Facts())
    check(way, Facts(stale=STALE_S))


@pytest.mark.parametrize(("first", "second"), list(combinations(NEVER, 2)))
def test_the_more_urgent_of_two_conditions_is_named(first, second):
    """By the queue, which every condition refuses."""
    with pytest.raises(NEVER[first][1]) as caught:
        check("queue", Facts(**NEVER[first][0], **NEVER[second][0]))
    assert NEVER[first][2] in str(getattr(caught.value, "problems", caught.value))
