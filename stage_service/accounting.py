"""Every pulse against every frame: which frame belongs to which step, and which never came.

A camera numbers its frames; the trigger box counts its pulses. Between two frames of a camera that
we read there were `m` pulses of which it answered none, so its number may advance by 1 (it missed
the pulses) up to 1 + m (frames were made and lost on the way). Anything else means that frames and
pulses are out of step, and that frames could stand for the wrong light.
"""

from __future__ import annotations

from stage_service.devices.errors import IndexShift


class PulseAccount:
    """The trigger box's count: each pulse commanded must raise it by exactly one."""

    def __init__(self, device: str, count: int = 0) -> None:
        self.device = device
        self.count = count

    def fired(self, count: int) -> None:
        """Take the box's answer to a pulse. Raises `IndexShift` for doubled or lost pulses."""
        expected = self.count + 1
        if count != expected:
            raise IndexShift(
                self.device,
                "counting pulses",
                expected=f"pulse {expected}",
                received=f"pulse {count}",
                todo="Somebody else fires the cameras, or the box restarted: start again.",
            )
        self.count = count


class FrameAccount:
    """One camera's block ids against the pulses that it should have answered."""

    def __init__(self, device: str, wrap: int) -> None:
        self.device = device
        self.wrap = wrap
        self.last: int | None = None
        self.unanswered = 0

    def missed(self) -> None:
        """A pulse after which the camera had no frame."""
        self.unanswered += 1

    def arrived(self, block_id: int) -> None:
        """The frame of the newest pulse. Raises `IndexShift` when its number does not fit."""
        self._advance(block_id, 1 + self.unanswered)
        self.unanswered = 0

    def late(self, block_id: int) -> None:
        """A frame of a pulse that counted as unanswered. Raises `IndexShift` when it cannot be."""
        if self.unanswered == 0:
            raise self._shift(
                "no frame beside those of our pulses",
                block_id,
                "The camera was triggered by something else: frames since the last check may "
                "belong to other steps. Check the trigger cable and start again.",
            )
        self._advance(block_id, self.unanswered)
        self.unanswered -= 1

    def _advance(self, block_id: int, most: int) -> None:
        before = 0 if self.last is None else self.last
        advance = (block_id - before) % self.wrap
        if not 1 <= block_id <= self.wrap or not 1 <= advance <= most:
            ids = [(before + k - 1) % self.wrap + 1 for k in (1, most)]
            raise self._shift(
                f"block id {ids[0]}" + (f" to {ids[1]}" if most > 1 else ""),
                block_id,
                "Frames and pulses are out of step. Check the trigger cable for doubled pulses "
                "and start again.",
            )
        self.last = block_id

    def _shift(self, expected: str, block_id: int, todo: str) -> IndexShift:
        return IndexShift(
            self.device,
            "matching frames to pulses",
            expected=expected,
            received=f"block id {block_id}",
            todo=todo,
        )
