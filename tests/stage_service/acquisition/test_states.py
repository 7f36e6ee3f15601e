"""The one table of states and outcomes."""

from __future__ import annotations

from typing import get_args

import pytest

from stage_service.acquisition.states import (
    OUTCOMES,
    TRANSITIONS,
    Machine,
    Outcome,
    State,
    WrongState,
)


def test_every_state_is_in_the_table_and_leads_to_done():
    assert set(TRANSITIONS) == set(get_args(State))
    for state in TRANSITIONS:
        observed, new = set(), {state}
        while new:
            observed |= new
            new = {after for s in new for after in TRANSITIONS[s].values()} - observed
        assert "done" in observed
    assert set(OUTCOMES.values()) < set(get_args(Outcome))


def test_whatever_is_not_in_the_table_is_refused_and_changes_nothing():
    machine = Machine()
    with pytest.raises(
        WrongState, match="cannot pause a capture that is idle; possible now: abort"
    ):
        machine.do("pause")
    assert (machine.state, machine.outcome) == ("idle", None)
    for action in ("start", "pause", "resume", "complete", "finish"):
        machine.do(action)
    assert (machine.state, machine.outcome) == ("done", "completed")
    with pytest.raises(WrongState, match="possible now: nothing"):
        machine.do("abort")


@pytest.mark.parametrize(
    ("done", "allowed"),
    [
        (("start",), "running; possible now: abort, pause"),
        (("start", "pause"), "pausing; possible now: abort, resume"),
        (("start", "pause", "hold"), "paused; possible now: abort, resume"),
        (("start", "complete"), "finishing; possible now: nothing"),
        (("start", "fail", "finish"), "done (failed); possible now: resume"),
        (("start", "complete", "finish"), "done (completed); possible now: nothing"),
    ],
)
def test_a_refusal_names_the_allowed_actions(done, allowed):
    machine = Machine()
    for action in done:
        machine.do(action)
    with pytest.raises(WrongState) as refused:
        machine.do("start")
    assert str(refused.value) == f"cannot start a capture that is {allowed}"


@pytest.mark.parametrize("end", [("abort", "stop"), ("fail",)])
def test_only_what_did_not_complete_can_be_continued(end):
    machine = Machine()
    for action in ("start", *end, "finish", "continue"):
        machine.do(action)
    assert machine.state == "running"
    for action in ("complete", "finish"):
        machine.do(action)
    assert not machine.allows("continue")


def test_a_failure_while_finishing_wins():
    machine = Machine()
    for action in ("start", "complete", "fail", "finish"):
        machine.do(action)
    assert machine.outcome == "failed"
