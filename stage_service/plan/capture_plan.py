"""What to shoot, as REST, CLI and plan files have it; `resolved` applies it to a rig."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from stage_service.config import Exposure, Level, Name, Names, Text
from stage_service.device_config import Strict
from stage_service.plan.person_text import LINES

MOST_ROWS = 100_000
Bracket = Annotated[float, Field(gt=0.0, le=1000.0)]


Weight = Annotated[float, Field(ge=0.0, le=1.0)]
Row = Annotated[dict[Name, Weight] | tuple[Name, ...], Field(min_length=1, max_length=4096)]
PatternTable = Annotated[dict[Name, Row], Field(min_length=1, max_length=4096)]
"""By pattern, weights by light, or the lights that are fully on; other lights are off."""


class KindExposures(Strict):
    """Seconds per kind of step; None takes the rig file's."""

    dark: Exposure | None = None
    all_on: Exposure | None = None
    olat: Exposure | None = None
    pattern: Exposure | None = None
    scanline: Exposure | None = None
    tracking: Exposure | None = None


class KindLevels(Strict):
    """Levels per kind of step, above 0 up to 1; None takes the rig file's."""

    all_on: Level | None = None
    olat: Level | None = None
    pattern: Level | None = None
    scanline: Level | None = None
    tracking: Level | None = None


class Rows(Strict):
    """Scanlines `first` up to and including `last` (None: the last row), with a `step` of 1."""

    first: Annotated[int, Field(ge=0, le=MOST_ROWS)] = 0
    last: Annotated[int, Field(ge=0, le=MOST_ROWS)] | None = None
    step: Literal[1] = 1


class CapturePlan(Strict):
    """What to shoot. The order is: dark, all on; each light alone; the sweep; dark, all on.

    `patterns` replace single lights: a table of weights, or one made for `lights`: "s_matrix", as
    many patterns of half of them as determine them, or "gradients", full and along each axis.
    `brackets` are factors on the exposure of a light or pattern: all at the first factor, then
    all at the next, so that cameras are armed once for each. `rate_hz` limits the steps per second.
    `stepping`: the service or the trigger box clocks the steps; "auto" prefers the box. `consent`
    records who agreed, when, and to what, if a living subject sees flashes of 3 to 30 Hz.
    A fully lit frame precedes every `lit_every` lights and follows the last one, for
    `hairstage stabilise`; 0: none.

    In the sweep a tracking frame precedes every full group of `tracking_every` scanlines of a
    projector, floor(rows / tracking_every) times and at least once: 76 for 768 rows. The remaining
    rows follow the last full group. 0: no tracking frames.
    """

    lights: Literal["all"] | Names = "all"
    patterns: Literal["s_matrix", "gradients"] | PatternTable | None = None
    projectors: Literal["all"] | Names = "all"
    rows: Rows = Rows()
    sentinels: bool = True
    brackets: Annotated[tuple[Bracket, ...], Field(min_length=1, max_length=8)] = (1.0,)
    lit_every: Annotated[int, Field(ge=0, le=MOST_ROWS)] = 0
    stepping: Literal["auto", "software", "hardware"] = "auto"
    rate_hz: Annotated[float, Field(ge=0.01, le=1000.0)] | None = None
    consent: Annotated[str, Text, Field(min_length=12, max_length=2000), LINES] | None = None
    tracking_every: Annotated[int, Field(ge=0, le=MOST_ROWS)] | None = None
    retries: Annotated[int, Field(ge=0, le=20)] | None = None
    exposure: KindExposures = KindExposures()
    level: KindLevels = KindLevels()
