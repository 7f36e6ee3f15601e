"""A light bank that enforces the rig file's `[safety]` limits."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager

from stage_service.config import SafetyLimits
from stage_service.devices.errors import DeviceError, SafetyRefusal
from stage_service.devices.lights.interface import (
    CONTRADICTED,
    LightBank,
    LightStatus,
    Lit,
)
from stage_service.devices.permission import lighting

AGAIN_S = 0.1
"""Seconds until lamps that could not be put off are tried again."""


class LimitedLightBank:
    """Implements `LightBank` over `bank`. A command beyond `limits` raises `SafetyRefusal`; one
    that may light a lamp raises `NotPermitted` without a live permission of the calling thread.

    A thread of this bank puts off a lamp that is lit for too long, or for too large a share of the
    time. From then on every command but `off` raises, heartbeats too, so that the watchdog of a
    bank that ignores `off` acts; `connect` resets this. Hardware-stepped sequences are checked
    entry by entry before any lamp is lit. `lights` are the lamps' names in the rig, for errors.
    """

    def __init__(
        self,
        bank: LightBank,
        limits: SafetyLimits,
        clock: Callable[[], float] = time.monotonic,
        lights: Sequence[str] = (),
    ) -> None:
        self.name, self.capabilities = bank.name, bank.capabilities
        self._bank, self._limits, self._clock = bank, limits, clock
        self._lights = lights
        self.contradicted = False
        """Whether the bank `CONTRADICTED` a command and has confirmed no lit lamp since."""
        self._level = 1.0  # a bank's level at power-up
        self._since: dict[int, float] = {}
        # By lamp, spans in which it was lit; kept across connections, for its duty.
        self._past: dict[int, deque[tuple[float, float]]] = {}
        self._refusal: SafetyRefusal | None = None
        self._changed = threading.Condition(threading.RLock())
        self._wakes = 0.0
        self._thread: threading.Thread | None = None

    @property
    def count(self) -> int:
        return self._bank.count

    def connect(self) -> None:
        """Open the link and forget an earlier refusal."""
        self._bank.connect()
        with self._changed:
            self._refusal = None

    def close(self) -> None:
        """Close the link; the lamps stay as they are, without limits."""
        with self._changed:
            thread, self._thread = self._thread, None
            self._changed.notify_all()
        if thread is not None and thread is not threading.current_thread():
            thread.join()
        self._bank.close()

    def select(self, lamp: int) -> None:
        doing = f"putting lamp {lamp} on"
        with lighting(doing), self._changed:
            self._allow((lamp,), doing)
            with self._confirming():
                self._bank.select(lamp)

    def all_on(self) -> None:
        doing = "putting all lamps on"
        with lighting(doing), self._changed:
            self._allow(range(self.count), doing)
            with self._confirming():
                self._bank.all_on()

    def show(self, levels: Sequence[float]) -> None:
        lamps = [lamp for lamp, level in enumerate(levels) if level > 0]
        doing = f"putting {len(lamps)} lamps on at levels of their own"
        if not lamps or not all(0 <= level <= 1 for level in levels):
            raise ValueError(f"{self.name}: {doing}: expected levels of 0 to 1, at least one lit")
        with lighting(doing), self._changed:
            self._allow(lamps, doing, sum(levels) / len(lamps))
            self._level = max(self._level, *levels)  # which the bank may keep
            with self._confirming():
                self._bank.show(levels)

    def off(self) -> None:
        """Put every lamp off; never refused. An error names what may still be lit."""
        with self._changed:
            try:
                self._bank.off()
            except DeviceError as error:
                raise self._naming_the_lit(error) from error
            self._lit(())
            self._cut_future_spans()

    def set_level(self, level: float) -> None:
        doing = f"setting the level to {level:g}"
        with lighting(doing), self._changed:  # a lamp that is selected at level 0 would light
            self._raise_refusal()
            self._check_power(len(self._since), level, doing)
            self._bank.set_level(level)
            self._level = level

    def set_watchdog(self, seconds: float) -> None:
        self._bank.set_watchdog(seconds)

    def claim(self, number: int, name: str) -> str | None:
        return self._bank.claim(number, name)

    def heartbeat(self) -> None:
        """Feed the watchdog, unless lamps had to be put off."""
        self._raise_refusal()
        self._bank.heartbeat()

    def status(self) -> LightStatus:
        """Read the status back; raises the refusal for which lit lamps were put off."""
        if self._since:
            self._raise_refusal()
        return self._bank.status()

    def load_sequence(
        self, entries: Sequence[tuple[Lit, float]], times: Sequence[tuple[float, float]] = ()
    ) -> None:
        """Check each entry and upload them. `times`: the span in which each is lit, in seconds from
        now; it counts for the duty unless `off` comes before."""
        with lighting("arming a sequence of lamps"), self._changed:
            self._raise_refusal()
            now, spans = self._clock(), []
            for number, (lit, level) in enumerate(entries):
                all_or_none = range(self.count) if lit == "all" else ()
                lamps = all_or_none if isinstance(lit, str) else (lit,)
                doing = f"loading entry {number} of a sequence"
                self._check_lamps(len(lamps), doing)
                self._check_power(len(lamps), level, doing)
                spans += [(x, doing, times[number]) for x in lamps if times]
            self._bank.load_sequence(entries)
            self._lit(())
            if self._limits.max_duty < 1:
                self._book(spans, now)

    def position(self) -> int:
        return self._bank.position()

    def enforce(self) -> float:
        """Put the lamps off if one has been lit too long; returns seconds until the next check."""
        with self._changed:
            if not self._since:
                return self._limits.max_on_s
            if self._refusal is None:
                now = self._clock()
                left, lamp = min((self._left(x, now), x) for x in self._since)
                if left > 0:
                    return left
                self._refusal = self._too_long(lamp, now, f"keeping lamp {lamp} lit")
            try:
                self._bank.off()
            except Exception:  # no heartbeats any more: the bank's own watchdog acts, too
                return AGAIN_S
            return self._limits.max_on_s

    def _allow(self, lamps: Sequence[int], doing: str, level: float | None = None) -> None:
        """Count these lamps as lit from now on; `level` is their mean, None the level that was set.
        Raises `SafetyRefusal`."""
        self._raise_refusal()
        self._check_lamps(len(lamps), doing)
        self._check_power(len(lamps), self._level if level is None else level, doing)
        self._lit(lamps)
        now = self._clock()
        left, lamp = min((self._left(x, now), x) for x in lamps)
        if left <= 0:
            refusal = self._too_long(lamp, now, doing)
            self._bank.off()
            self._lit(())
            raise refusal
        if self._thread is None:
            self._thread = threading.Thread(target=self._watch, name="lamp limits", daemon=True)
            self._thread.start()
        elif now + left < self._wakes:
            self._changed.notify_all()

    def _lit(self, lamps: Iterable[int]) -> None:
        """Set which lamps are lit from now on, and record the spans of the others."""
        now, before = self._clock(), self._since
        self._since = {x: before.get(x, now) for x in lamps}
        if self._limits.max_duty < 1:
            for lamp in before.keys() - self._since.keys():
                self._past.setdefault(lamp, deque()).append((before[lamp], now))

    def _book(self, spans: Iterable[tuple[int, str, tuple[float, float]]], now: float) -> None:
        """Record the spans in which lamps will be lit. Raises `SafetyRefusal` after leaving the
        bank's sequence."""
        for lamp, doing, (begin, end) in spans:
            self._past.setdefault(lamp, deque()).append((now + begin, now + end))
            used = self._used(lamp, now + end)
            if used > self._limits.max_duty * self._limits.duty_window_s:
                self.off()
                raise self._too_much(doing, used)

    def _cut_future_spans(self) -> None:
        now = self._clock()
        for past in self._past.values():
            while past and past[-1][1] > now:
                begin, _ = past.pop()
                if begin < now:
                    past.append((begin, now))

    def _left(self, lamp: int, now: float) -> float:
        """Seconds that a lamp may stay lit from `now`."""
        limits = self._limits
        left = self._since.get(lamp, now) + limits.max_on_s - now
        if limits.max_duty < 1:
            left = min(left, limits.max_duty * limits.duty_window_s - self._used(lamp, now))
        return left

    def _used(self, lamp: int, at: float) -> float:
        """Seconds that the lamp is lit within the duty window that ends `at`."""
        window, past = self._limits.duty_window_s, self._past.get(lamp, deque())
        while past and past[0][1] <= self._clock() - window:
            past.popleft()
        spans = [*past, (self._since.get(lamp, at), at)]
        return sum(max(0.0, min(end, at) - max(start, at - window)) for start, end in spans)

    def _too_long(self, lamp: int, now: float, doing: str) -> SafetyRefusal:
        limits, on = self._limits, now - self._since.get(lamp, now)
        if on >= limits.max_on_s:
            expected = f"at most {limits.max_on_s:g} s (max_on_s in [safety])"
            todo = (
                "It was put off. Shorten the exposure; a slow device, or a service that "
                "stood still, also puts it off late."
            )
            return self._error(doing, expected, f"commanded on for {on:.3g} s", todo)
        return self._too_much(doing, self._used(lamp, now))

    def _too_much(self, doing: str, used: float) -> SafetyRefusal:
        limits, window = self._limits, self._limits.duty_window_s
        share = f"{limits.max_duty * window:.3g} s of {window:g} s"
        expected = f"at most {share} (max_duty in [safety])"
        todo = "Let the lamp cool, then continue; a lower rate_hz gives it time."
        return self._error(doing, expected, f"lit for {used:.3g} s", todo)

    def _check_lamps(self, lamps: int, doing: str) -> None:
        most = self._limits.max_lamps
        if most is not None and lamps > most:
            expected = f"at most {most} lamps lit (max_lamps in [safety])"
            todo = "Leave the sentinels out of the plan (sentinels = false), or light fewer in a "
            todo += "pattern."
            raise self._error(doing, expected, f"{lamps} requested", todo)

    def _check_power(self, lamps: int, level: float, doing: str) -> None:
        most, power = self._limits.max_power_w, lamps * level * self._limits.lamp_power_w
        if most is not None and power > most:
            expected = f"at most {most:g} W (max_power_w in [safety])"
            received = f"{lamps} lamps at level {level:g}, {power:.4g} W"
            todo = "Lower the level in the plan."
            raise self._error(doing, expected, received, todo)

    def _raise_refusal(self) -> None:
        if self._refusal is not None:
            raise self._refusal

    @contextmanager
    def _confirming(self) -> Iterator[None]:
        """Track whether the bank confirms the lamps that it is commanded to light."""
        try:
            yield
        except DeviceError as error:
            self.contradicted |= CONTRADICTED in str(error)
            raise
        self.contradicted = False

    def _naming_the_lit(self, error: DeviceError) -> DeviceError:
        if not self._since:
            return error
        lamp = min(self._since)
        name = self._lights[lamp] if lamp < len(self._lights) else f"lamp {lamp}"
        last = f"{name} was" if len(self._since) == 1 else f"{len(self._since)} lamps were"
        received = f"{error.received} ({last} lit last)"
        fields = error.device, error.operation, error.expected, received, error.todo
        return type(error)(*fields, deadline_s=error.deadline_s)

    def _watch(self) -> None:
        """Run `enforce` whenever it is due."""
        with self._changed:
            while self._thread is threading.current_thread():
                wait = self.enforce()
                self._wakes = self._clock() + wait
                self._changed.wait(wait)

    def _error(self, doing: str, expected: str, received: str, todo: str) -> SafetyRefusal:
        return SafetyRefusal(self.name, doing, expected, received, todo)
