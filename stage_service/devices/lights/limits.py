"""Errors for what a light bank cannot do."""

from __future__ import annotations

from collections.abc import Sequence

from stage_service.devices.errors import DeviceError
from stage_service.devices.lights.interface import LightCapabilities


def refuse_unverified_blackout(name: str, can: LightCapabilities, accepted: bool) -> None:
    """Raise `DeviceError` for a bank that cannot guarantee a blackout, unless that is accepted."""
    lacking = []
    if not can.reads_back:
        lacking.append("no read-back: the service cannot confirm that the lamps are off")
    if not can.dead_man:
        lacking.append("no dead-man: when the service or the cable dies, lit lamps stay lit")
    if lacking and not accepted:
        doing, expected = "checking that a blackout can be guaranteed", "read-back and a dead-man"
        todo = "Wire the emergency stop and a timer into the lamps' supply, then set "
        todo += "accept_unverified_blackout = true in [devices.lights]."
        raise DeviceError(name, doing, expected, "; ".join(lacking), todo)


def level_word(name: str, doing: str, level: float, steps: int) -> int:
    """A level of 0 to 1 in steps of 1 / `steps`. Raises `ValueError` outside 0 to 1, `DeviceError`
    for a level above 0 that would become 0."""
    if not 0 <= level <= 1:
        raise ValueError(f"{name}: a level is 0 to 1, got {level}")
    if level > 0 and round(level * steps) == 0:
        expected = f"0, or more than {0.5 / steps:.3g}: it has {steps} levels above 0"
        todo = "Use a shorter exposure at a higher level."
        raise DeviceError(name, doing, expected, f"{level:g}", todo)
    return round(level * steps)


def level_words(
    name: str, doing: str, levels: Sequence[float], lamps: int, steps: int
) -> list[int]:
    """`level_word` of each lamp. Raises `ValueError` for another number of lamps, `DeviceError` for
    a level between 0 and 1 where lamps are on or off."""
    if len(levels) != lamps:
        raise ValueError(f"{name}: expected levels of {lamps} lamps, got {len(levels)}")
    if steps == 1 and any(0 < level < 1 for level in levels):
        raise cannot(name, doing, "levels")
    return [level_word(name, doing, level, steps) for level in levels]


def cannot(name: str, doing: str, lacks: str) -> DeviceError:
    """The error of a call that the capabilities exclude."""
    todo = "Check its capabilities first; [devices.lights] describes the bank."
    return DeviceError(name, doing, lacks, "a light bank without", todo)
