"""The predicted times at which a plan's lights go on and off."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from reconstruction import Step
from stage_service.config import RigFile
from stage_service.plan.stepping import LATENCY_S, UPLOAD_S, Run, period_s


class Lit(NamedTuple):
    """A step whose light is on from `at` seconds after the start, for `seconds`."""

    step: Step
    at: float
    seconds: float


def timeline(
    parts: Sequence[Run], rig_file: RigFile, *, rate_hz: float | None, lag_s: float = 0.0
) -> Iterator[Lit]:
    """The steps that light something, in order, without retries.

    `lag_s` is each step's wait for the disk. In hardware the link and the disk catch up between
    runs, while the next table is uploaded.
    """
    devices = rig_file.devices
    now = 0.0
    settle = readout = link = lag = 0.0
    if devices is not None:
        settle, readout = devices.lights.settle_s, devices.cameras.readout_s
        lag = devices.cameras.lag_s
        pixels = sum(c.width * c.height for c in rig_file.rig.cameras)
        link = 6 * pixels / devices.cameras.bytes_per_s
    for run in parts:
        began = now
        by_box = devices if run.stepping == "hardware" else None
        for step in run.steps:
            lit = settle + step.exposure + (lag + LATENCY_S if by_box is None else 0.0)
            if step.kind != "dark":
                yield Lit(step, now, lit)
            if by_box is not None:
                now += period_s(step, by_box, rate_hz)
            else:
                now += max(lit + readout + link, 1 / rate_hz if rate_hz else 0.0) + lag_s
        if by_box is not None:
            now = max(now, began + len(run.steps) * link) + UPLOAD_S + len(run.steps) * lag_s
