"""The flash rate of a plan, and whether a living subject may be in front of it.

Flashes of 3 to 30 Hz are those that most often set off seizures (Epilepsy Society, "Photosensitive
epilepsy"); up to three flashes in a second pass (W3C, WCAG 2.2, success criterion 2.3.1).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from typing import Literal

from reconstruction import Step
from stage_service.device_config import Strict
from stage_service.plan.timeline import Lit

SLOWEST_HZ, FASTEST_HZ = 3.0, 30.0
IN_A_ROW = 3
"""Intervals within a second (of four flashes) that make a rate."""
SLOW_HZ = 2.5
"""The suggested rate: below the band, with room for early steps."""

Band = Literal["below 3 Hz", "3 to 30 Hz", "above 30 Hz"]
IN_BAND: Band = "3 to 30 Hz"
ROUNDING = 1e-9


class FlashRate(Strict):
    """The predicted flash rate: `hz`, over four consecutive flashes, determines the band.

    Retries, a slow link or a slow disk can bring a faster rate into the band, so the rate is
    measured during the run, too. `by_kind` has the rate of each kind of step.
    """

    hz: float
    band: Band
    by_kind: dict[str, float]
    needs_consent: bool


class FlashRefusal(RuntimeError):
    """A plan that flashes in the band; `problems` has the remedies."""

    def __init__(
        self, rate: FlashRate, consent: str | None, *, seconds: float, slow_seconds: float
    ) -> None:
        lacks = "the operator has not armed it" if consent else "no consent is recorded"
        self.problems = [
            f"the plan flashes at {rate.hz:.1f} Hz, within {SLOWEST_HZ:g} to {FASTEST_HZ:g} Hz, "
            f"before a living subject, and {lacks}",
            f"either set rate_hz to {SLOW_HZ:g} in the plan, which keeps it below the band and "
            f"takes {slow_seconds:.0f} s instead of {seconds:.0f} s",
            "or record in the plan's consent who agreed to what and when, and name in armed_by the "
            "person at the stage who is responsible",
            "a mannequin or a simulated subject: set living_subject = false in [safety] of the rig "
            "file",
        ]
        super().__init__("; ".join(self.problems))


class _Train:
    """Consecutive flashes of one kind, with the newest intervals that are in the band.

    `uneven`: they differ in brightness, so that every n-th may stand out. Above the band they count
    as the fastest rate / n within it.
    """

    def __init__(self, uneven: bool = False) -> None:
        self._uneven = uneven
        self._last: float | None = None
        self._begins: deque[float] = deque(maxlen=IN_A_ROW)
        self._newest: deque[float] = deque(maxlen=IN_A_ROW + 1)

    def add(self, at: float) -> float | None:
        """Add a flash; returns the rate in Hz if it is within the band."""
        before, self._last = self._last, at
        self._newest.append(at)
        if before is None:
            return None
        low, high = 1 / FASTEST_HZ - ROUNDING, 1 / SLOWEST_HZ + ROUNDING
        if at - before > high or (at - before < low and not self._uneven):
            return None
        self._begins.append(before)
        if len(self._begins) < IN_A_ROW or at - self._begins[0] > 1 + ROUNDING:
            return None
        rate = IN_A_ROW / max(at - self._begins[0], ROUNDING)
        return rate / max(1, math.ceil(rate / FASTEST_HZ - ROUNDING))

    def rate(self) -> float:
        """Hz over the newest flashes; 0 if they are too few."""
        if len(self._newest) <= IN_A_ROW or self._newest[-1] <= self._newest[0]:
            return 0.0
        return IN_A_ROW / (self._newest[-1] - self._newest[0])


class Trains:
    """All lights as one train, and the full-field flashes among them as another: tracking frames
    are much brighter than scanlines and have a rate of their own. So have patterns of lights, whose
    brightness varies."""

    def __init__(self) -> None:
        self.each = _Train()
        self._full_field = _Train()
        self._patterns = _Train(uneven=True)

    def add(self, step: Step, at: float) -> float | None:
        """The rate in the band after this flash, or None."""
        rates = [self.each.add(at)]
        if step.kind in ("tracking", "all_on"):
            rates.append(self._full_field.add(at))
        if step.kind == "pattern":
            rates.append(self._patterns.add(at))
        found = [r for r in rates if r is not None]
        return max(found) if found else None


def flash_rate(lights: Iterable[Lit], living_subject: bool) -> FlashRate:
    """Classify a plan by its predicted timeline."""
    trains, worst, fastest = Trains(), 0.0, 0.0
    kinds, by_kind = dict[str, _Train](), dict[str, float]()
    for lit in lights:
        worst = max(worst, trains.add(lit.step, lit.at) or 0.0)
        fastest = max(fastest, trains.each.rate())
        kind = lit.step.kind
        own = kinds.setdefault(kind, _Train())
        own.add(lit.at)
        by_kind[kind] = max(by_kind.get(kind, 0.0), own.rate())
    if worst:
        return FlashRate(hz=worst, band=IN_BAND, by_kind=by_kind, needs_consent=living_subject)
    band: Band = "above 30 Hz" if fastest > FASTEST_HZ else "below 3 Hz"
    return FlashRate(hz=fastest, band=band, by_kind=by_kind, needs_consent=False)
