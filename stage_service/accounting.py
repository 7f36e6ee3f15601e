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
        before = 0 if self.last is None else self.last
        advance = (block_id - before) % self.wrap
        most = 1 + self.unanswered
        if not 1 <= block_id <= self.wrap or not 1 <= advance <= most:
            ids = [(before + k - 1) % self.wrap + 1 for k in range(1, most + 1)]
            raise IndexShift(
                self.device,
                "matching frames to pulses",
                expected=f"block id {ids[0]}" + (f" to {ids[-1]}" if most > 1 else ""),
                received=f"block id {block_id}",
                todo="Frames and pulses are out of step; check the trigger cable for doubled "
                "pulses and start again.",
            )
        self.last = block_id
        self.unanswered = 0

    def surplus(self, block_id: int) -> IndexShift:
        """The error for a frame that no pulse of ours asked for."""
        return IndexShift(
            self.device,
            "emptying the frame queue",
            expected="no frame beside those of our pulses",
            received=f"block id {block_id}",
            todo="The camera was triggered by something else: frames since the last check may "
            "belong to other steps. Check the trigger cable and start again.",
        )
