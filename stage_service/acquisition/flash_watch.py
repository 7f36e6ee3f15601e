"""The flash rate, measured while running."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from reconstruction import Step
from stage_service.devices.errors import SafetyRefusal
from stage_service.plan.flash import FASTEST_HZ, SLOW_HZ, SLOWEST_HZ, Trains


class FlashWatch:
    """Measures the flash rate while running. Call it as each step's light is about to go on.

    Raises `SafetyRefusal` before the flash that makes the rate fall into the band.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._trains = Trains()
        self._lock = threading.Lock()

    def __call__(self, step: Step) -> None:
        """Take the flash of a step that is about to be lit. Raises `SafetyRefusal`."""
        if step.kind == "dark":
            return
        with self._lock:
            rate = self._trains.add(step, self._clock())
        if rate is not None:
            raise SafetyRefusal(
                "stage",
                f"lighting step {step.index} ({step.kind})",
                expected=f"flashes slower than {SLOWEST_HZ:g} or faster than {FASTEST_HZ:g} Hz: "
                "no consent is armed",
                received=f"{rate:.1f} Hz",
                todo=f"Set rate_hz to {SLOW_HZ:g} in the plan, or record consent and arm it.",
            )
