"""Where a capture is and how it ended: one table for the sequencer, the API and the tests."""

from __future__ import annotations

from typing import Literal

State = Literal["idle", "running", "paused", "finishing", "done"]
Outcome = Literal["completed", "aborted", "failed", "interrupted"]

TRANSITIONS: dict[State, dict[str, State]] = {
    "idle": {"start": "running", "abort": "finishing", "fail": "finishing"},
    "running": {
        "pause": "paused",
        "complete": "finishing",
        "abort": "finishing",
        "fail": "finishing",
    },
    "paused": {"resume": "running", "abort": "finishing", "fail": "finishing"},
    "finishing": {"finish": "done", "fail": "finishing"},
    "done": {"continue": "running"},
}
"""state -> action -> next state; whatever is not listed is refused.

"continue" shoots what a capture lacks that is done and did not complete: a new run, which starts
where the table says that a run starts.
"""

OUTCOMES: dict[str, Outcome] = {"complete": "completed", "abort": "aborted", "fail": "failed"}
"""The outcome that the action decides; a later failure wins over an earlier success."""


def possible(state: State, outcome: Outcome | None) -> dict[str, State]:
    """The actions that a state allows, and where they lead; a completed capture is over."""
    return {} if state == "done" and outcome == "completed" else TRANSITIONS[state]


class WrongState(RuntimeError):
    """The state does not allow the action; the message lists what it allows."""

    def __init__(self, action: str, state: State, outcome: Outcome | None = None) -> None:
        allowed = ", ".join(sorted(possible(state, outcome))) or "nothing"
        super().__init__(f"cannot {action} a capture that is {state}; possible now: {allowed}")
        self.action, self.state = action, state


class Machine:
    """A state and an outcome that only change as `TRANSITIONS` allows. Not locked: the owner is."""

    def __init__(self) -> None:
        self.state: State = "idle"
        self.outcome: Outcome | None = None

    def allows(self, action: str) -> bool:
        """Whether `action` is possible now."""
        return action in possible(self.state, self.outcome)

    def do(self, action: str) -> State:
        """Move along the table; raises `WrongState` for what is not in it."""
        if not self.allows(action):
            raise WrongState(action, self.state, self.outcome)
        self.state = TRANSITIONS[self.state][action]
        self.outcome = OUTCOMES.get(action, self.outcome)
        return self.state
