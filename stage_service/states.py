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
    "done": {},
}
"""state -> action -> next state; whatever is not listed is refused."""

OUTCOMES: dict[str, Outcome] = {"complete": "completed", "abort": "aborted", "fail": "failed"}
"""The outcome that the action decides; a later failure wins over an earlier success."""


class WrongState(RuntimeError):
    """The state does not allow the action; the message lists what it allows."""

    def __init__(self, action: str, state: State) -> None:
        allowed = ", ".join(sorted(TRANSITIONS[state])) or "nothing"
        super().__init__(f"cannot {action} a capture that is {state}; possible now: {allowed}")
        self.action, self.state = action, state


class Machine:
    """A state and an outcome that only change as `TRANSITIONS` allows. Not locked: the owner is."""

    def __init__(self) -> None:
        self.state: State = "idle"
        self.outcome: Outcome | None = None

    def allows(self, action: str) -> bool:
        """Whether `action` is possible now."""
        return action in TRANSITIONS[self.state]

    def do(self, action: str) -> State:
        """Move along the table; raises `WrongState` for what is not in it."""
        if not self.allows(action):
            raise WrongState(action, self.state)
        self.state = TRANSITIONS[self.state][action]
        self.outcome = OUTCOMES.get(action, self.outcome)
        return self.state
