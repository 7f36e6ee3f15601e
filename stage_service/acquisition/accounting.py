"""Every pulse against every frame: which frame belongs to which step, and which never came.

A camera numbers its frames; the trigger box counts its pulses. Between two frames of a camera that
the service read lie `m` pulses without a frame, so its number may advance by 1 (the camera missed
the pulses) up to 1 + m (frames were made and lost on the way). Any other number means that frames
and pulses are out of step, and that frames may be assigned to the wrong light.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from stage_service.devices.errors import IndexShift

CLOCK_DRIFT = 2e-4
"""Largest relative difference between the rates of a camera's clock and the host's."""


class PulseAccount:
    """The trigger box's count: each pulse commanded must raise it by exactly one."""

    def __init__(self, device: str, count: int = 0) -> None:
        self.device = device
        self.count = count

    def fired(self, count: int) -> None:
        """Check the box's count after one pulse. Raises `IndexShift` for doubled or lost pulses."""
        self.ran(1, count)

    def ran(self, pulses: int, count: int) -> None:
        """Check the box's count after `pulses` pulses. Raises `IndexShift`."""
        expected = self.count + pulses
        if count != expected:
            received = f"pulse {count}"
            todo = (
                "Something else fires the cameras, or the box restarted: start the capture again."
            )
            raise IndexShift(self.device, "counting pulses", f"pulse {expected}", received, todo)
        self.count = count


class FrameAccount:
    """One camera's block ids against the pulses that should have made frames."""

    def __init__(self, device: str, wrap: int) -> None:
        self.device = device
        self.wrap = wrap
        self.last: int | None = None
        self.without_frame = 0
        self._ahead: tuple[float, float] | None = None
        self._timed_at = 0.0

    def armed(self) -> None:
        """Forget the clock offset: a time stamp depends on the exposure."""
        self._ahead = None

    def missed(self) -> None:
        """A pulse after which the camera had no frame."""
        self.without_frame += 1

    def arrived(self, block_id: int, left: int = 0) -> None:
        """The frame of the newest pulse, with `left` frames behind it.

        Raises `IndexShift` when its number does not fit, and when frames are behind it: then
        something else fired the camera.
        """
        self._advance(block_id, 1 + self.without_frame)
        self.without_frame = 0
        if left:
            raise self._stray(f"{left} behind block id {block_id}")

    def timed(self, timestamp: float, requested: float, replied: float) -> None:
        """Check that the frame was made by the newest pulse, which fired between the two times.

        Each frame bounds how far the host's clock is ahead of the camera's. A frame of an earlier
        pulse contradicts these bounds, because each pulse is requested after the box has replied
        to the one before. Raises `IndexShift`.
        """
        low, high = requested - timestamp, replied - timestamp
        if self._ahead is not None:
            slack = CLOCK_DRIFT * max(0.0, requested - self._timed_at)
            low = max(low, self._ahead[0] - slack)
            high = min(high, self._ahead[1] + slack)
        if low > high:
            doing, expected = "matching time stamps to pulses", "a frame made by the newest pulse"
            received = f"one made {low - high:.4g} s or more before or after it"
            todo = "Something else fired the camera, or a frame came late: check the trigger cable."
            raise IndexShift(self.device, doing, expected, received, todo)
        self._ahead, self._timed_at = (low, high), requested

    def late(self, block_id: int) -> None:
        """A frame of a pulse that was counted as missing. Raises `IndexShift` if it cannot be."""
        if self.without_frame == 0:
            raise self._stray(f"block id {block_id}")
        self._advance(block_id, self.without_frame)
        self.without_frame -= 1

    def place(self, block_ids: Sequence[int], pulses: int) -> list[int] | None:
        """The pulse that each frame of a hardware-stepped run belongs to, from 0.

        Gaps in the block ids are frames that were lost on the way. A trigger that came while the
        camera was busy leaves no gap; then the ids cannot show which pulse it was, and the result
        is None: no frame of the run may be used. Raises `IndexShift` for more frames than pulses,
        and for ids that repeat.
        """
        if not block_ids:
            self.without_frame += pulses
            return []
        skipped = self._advance(block_ids[0], pulses + self.without_frame) - 1
        after = [(b - block_ids[0]) % self.wrap for b in block_ids]
        rising = all(a < b for a, b in pairwise(after))
        in_range = all(1 <= b <= self.wrap for b in block_ids)
        if not in_range or not rising or after[-1] >= pulses:
            todo = "Something else fired the camera, or it repeats frames."
            raise self._shift(f"at most {pulses} frames with rising numbers", block_ids[-1], todo)
        # Ids that were skipped may have belonged to pulses before this run.
        start = max(0, skipped - self.without_frame)
        complete = start + after[-1] == pulses - 1 and (self.without_frame == 0 or start == 0)
        places = [start + k for k in after] if complete else None
        self.last = block_ids[-1]
        self.without_frame = 0 if complete else pulses - 1 - after[-1]
        return places

    def _advance(self, block_id: int, most: int) -> int:
        """Ids from the last frame's to this one, 1 to `most`; stores this one as the last."""
        before = self.last or 0
        advance = (block_id - before) % self.wrap
        if not 1 <= block_id <= self.wrap or not 1 <= advance <= most:
            ids = [(before + k - 1) % self.wrap + 1 for k in (1, most)]
            expected = f"block id {ids[0]}" + (f" to {ids[1]}" if most > 1 else "")
            raise self._shift(expected, block_id, "Frames and pulses are out of step.")
        self.last = block_id
        return advance

    def _stray(self, received: str) -> IndexShift:
        expected = "no frame beside those of our pulses"
        todo = "Something else fired the camera: frames since the last check may show other "
        todo += "steps. Check the trigger cable and start again."
        return IndexShift(self.device, "matching frames to pulses", expected, received, todo)

    def _shift(self, expected: str, block_id: int, why: str) -> IndexShift:
        todo = f"{why} Check the trigger cable for doubled pulses and start again."
        received = f"block id {block_id}"
        return IndexShift(self.device, "matching frames to pulses", expected, received, todo)
