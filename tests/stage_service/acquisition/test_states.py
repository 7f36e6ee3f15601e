"""The one table of states and outcomes."""

from __future__ import annotations

import pytest

from stage_service.acquisition.states import (
    Machine,
    WrongState,
)


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
