"""Which of service and trigger box clocks the steps, and how long they take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Literal

from reconstruction import Step
from stage_service.config import RigFile
from stage_service.device_config import DevicesConfig
from stage_service.plan.patterns import LAMP_KINDS

Stepping = Literal["software", "hardware"]

LATENCY_S = 0.002
"""Command, confirmation and pulse of a software-stepped step."""
UPLOAD_S = 0.05
"""Arming, uploading and starting a hardware-stepped run."""
NO_PATTERNS = "an entry of the light bank's sequence table lights one lamp or all"
SHORTEST_RUN = 8
"""Steps below which uploading a table takes longer than it saves."""


@dataclass(frozen=True)
class Run:
    """Consecutive steps with one kind of stepping; in hardware they share one exposure time."""

    steps: tuple[Step, ...]
    stepping: Stepping


def runs(
    steps: tuple[Step, ...], rig_file: RigFile, requested: Literal["auto", "software", "hardware"]
) -> tuple[tuple[Run, ...], str]:
    """Divide the steps of a plan into runs; returns them and the reason for their stepping.

    A hardware-stepped run has at most as many steps as the cameras can hold unread frames: the box
    cannot wait for a slow link or disk. The service lights the lamps of a bank without a sequence
    table.
    """
    devices = rig_file.devices
    why = ""
    if requested == "software":
        why = "the plan requests it"
    elif devices is None or not devices.hardware_stepping:
        why = "hardware_stepping is not set in the rig file: the trigger box's gates are not wired"
    elif devices.cameras.buffers < SHORTEST_RUN:
        why = f"the cameras hold only {devices.cameras.buffers} unread frames"
    if why:
        return (Run(steps, "software"),), why
    assert devices is not None
    out: list[Run] = []
    gated = devices.lights.sequences

    def alike(step: Step) -> tuple[float, bool]:
        by_table = gated and step.kind != "pattern"
        return step.exposure, by_table or step.kind not in LAMP_KINDS

    for (_, by_box), group in groupby(steps, key=alike):
        own = tuple(group)
        size = devices.cameras.buffers
        for i in range(0, len(own), size):
            part = own[i : i + size]
            stepping: Stepping = "hardware" if by_box and len(part) >= SHORTEST_RUN else "software"
            if out and out[-1].stepping == stepping == "software":
                part = out.pop().steps + part
            out.append(Run(part, stepping))
    clocked = sum(len(r.steps) for r in out if r.stepping == "hardware")
    lamps = "" if gated else "; the light bank has no sequence table, so the service lights lamps"
    if gated and any(s.kind == "pattern" for s in steps):
        lamps = f"; {NO_PATTERNS}, so the service lights patterns"
    if clocked == 0:
        return tuple(out), f"no {SHORTEST_RUN} steps in a row share an exposure time{lamps}"
    return tuple(out), f"the trigger box clocks {clocked} of {len(steps)} steps{lamps}"


def period_s(step: Step, devices: DevicesConfig, rate_hz: float | None) -> float:
    """Seconds from one hardware-stepped step to the next, sensor readout included."""
    light = devices.lights.settle_s + step.exposure
    return max(light + devices.cameras.readout_s, 1 / rate_hz if rate_hz else 0.0)


def seconds_by_cause(
    parts: Sequence[Run],
    rig_file: RigFile,
    *,
    wire_bytes: int,
    folder_bytes: int,
    rate_hz: float | None = None,
) -> dict[str, float]:
    """Predicted seconds by cause; `wire_bytes` and `folder_bytes` are those of one step.

    In software a step's frames are read before the next step begins; in hardware they are read
    during the run, so only the link's lag counts. Frames are written in parallel.
    """
    devices = rig_file.devices
    causes = dict.fromkeys(
        ("exposure", "settle", "readout", "link", "latency", "rate limit", "storage"), 0.0
    )
    steps = [s for r in parts for s in r.steps]
    causes["exposure"] = sum(s.exposure for s in steps)
    if devices is None:
        causes["latency"] = len(steps) * LATENCY_S
    else:
        causes["settle"] = len(steps) * devices.lights.settle_s
        causes["readout"] = len(steps) * devices.cameras.readout_s
        link = wire_bytes / devices.cameras.bytes_per_s
        for run in parts:
            own = [
                s.exposure + devices.lights.settle_s + devices.cameras.readout_s for s in run.steps
            ]
            n, shooting = len(own), sum(own)
            if run.stepping == "hardware":
                causes["latency"] += UPLOAD_S
                waiting = sum(period_s(s, devices, rate_hz) for s in run.steps) - shooting
                causes["rate limit"] += waiting
                causes["link"] += max(0.0, n * link - shooting - waiting)
            else:
                latency = LATENCY_S + devices.cameras.lag_s
                causes["latency"] += n * latency
                causes["link"] += n * link
                if rate_hz:
                    busy = (t + latency + link for t in own)
                    causes["rate limit"] += sum(max(0.0, 1 / rate_hz - t) for t in busy)
    writing = len(steps) * folder_bytes / rig_file.capture.storage_bytes_per_s
    causes["storage"] = max(0.0, writing - sum(causes.values()))
    return causes


def limited_by(causes: dict[str, float]) -> str:
    """The cause that takes most of the time, in a few words."""
    cause, seconds = max(causes.items(), key=lambda item: item[1])
    share = seconds / max(sum(causes.values()), 1e-12)
    return f"{cause}: {share:.0%} of the time"
