"""`[safety]` limits and levels of a plan: checked before anything is lit."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from reconstruction import Rig, Step
from reconstruction.arrays import Ints
from stage_service.config import PROJECTOR_LEVELS, SafetyLimits
from stage_service.device_config import LightBankConfig
from stage_service.plan.patterns import LAMP_KINDS, LampLevels
from stage_service.plan.stepping import Run
from stage_service.plan.timeline import Lit

PROJECTORS = PROJECTOR_LEVELS, "projector controller"
Light = tuple[str, str | None, float]


def check_limits(
    lights: Iterable[Lit], rig: Rig, limits: SafetyLimits, lamp_levels: LampLevels
) -> list[str]:
    """One sentence for each limit that the plan exceeds, its worst case; without retries."""
    steps = [x for x in lights if x.step.kind in LAMP_KINDS]
    if not steps:
        return []
    problems = []
    longest = max(steps, key=lambda x: x.seconds)
    if longest.seconds > limits.max_on_s:
        problems.append(
            f"exposure.{longest.step.kind}: step {longest.step.index} has a lamp lit for "
            f"{longest.seconds:.3g} s; [safety] max_on_s allows {limits.max_on_s:g} s: shorten the "
            "exposure or its brackets"
        )
    levels = {_light_of(x.step): lamp_levels(x.step) for x in steps}
    most_lit, most_drawn = dict[str, int](), dict[str, tuple[float, Step]]()
    for step in (x.step for x in steps):
        lit, drawn = np.count_nonzero(levels[_light_of(step)]), levels[_light_of(step)].sum()
        most_lit[step.kind] = max(most_lit.get(step.kind, 0), int(lit))
        if step.kind not in most_drawn or drawn > most_drawn[step.kind][0]:
            most_drawn[step.kind] = float(drawn), step
    for kind, count in most_lit.items():
        if limits.max_lamps is not None and count > limits.max_lamps:
            fewer = "light fewer in a pattern"
            if kind != "pattern":
                fewer = "leave the sentinels out (sentinels = false)"
            problems.append(
                f"{kind}: {count} lamps would be lit at once; [safety] max_lamps allows "
                f"{limits.max_lamps}: {fewer}"
            )
        drawn, step = most_drawn[kind]
        power = drawn * limits.lamp_power_w
        if limits.max_power_w is not None and power > limits.max_power_w:
            lit = np.count_nonzero(levels[_light_of(step)])
            lamps = f"{lit} lamps" if step.pattern is None else f"{lit} lamps of {step.pattern}"
            problems.append(
                f"level.{kind}: {lamps} at level {step.level:g} draw {power:.4g} W; [safety] "
                f"max_power_w allows {limits.max_power_w:g} W: at most level "
                f"{step.level * limits.max_power_w / power:.3g}"
            )
    if limits.max_duty < 1:
        lit_lamps = {light: np.flatnonzero(own) for light, own in levels.items()}
        problems += _check_duty(steps, rig, limits, lit_lamps)
    return problems


def _light_of(step: Step) -> Light:
    """What decides the levels of the lamps."""
    return step.kind, step.lighting, step.level


def check_levels(parts: Iterable[Run], bank: LightBankConfig) -> list[str]:
    """One sentence for each kind of step whose level the device would round to another, or to 0."""
    problems = {}
    for part in parts:
        lamps = bank.level_steps(by_table=part.stepping == "hardware")
        for step in part.steps:
            if step.kind == "dark":
                continue
            of_lamps = step.kind in LAMP_KINDS
            steps, who = (lamps, "light bank of [devices.lights]") if of_lamps else PROJECTORS
            what = f"level.{step.kind}: the {who}"
            if steps == 1 and step.level != 1:
                problems[step.kind] = (
                    f"{what} has no levels: its lamps are at 1, not at {step.level:g}"
                )
            elif round(step.level * steps) == 0:
                problems[step.kind] = (
                    f"{what} has {steps} levels above 0, so that {step.level:g} would be dark: use "
                    f"one above {0.5 / steps:.3g} and a shorter exposure"
                )
    return list(problems.values())


def _check_duty(
    steps: Sequence[Lit], rig: Rig, limits: SafetyLimits, lit_lamps: Mapping[Light, Ints]
) -> list[str]:
    window, most = limits.duty_window_s, limits.max_duty
    spans: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for lit in steps:
        for lamp in lit_lamps[_light_of(lit.step)]:
            spans[rig.lights[lamp].name].append((lit.at, lit.at + lit.seconds))
    worst, name = max((longest_on(own, window), name) for name, own in spans.items())
    if worst <= most * window:
        return []
    return [
        f"lamp {name} would be lit {worst:.3g} s of {window:g} s, {worst / window:.0%}; [safety] "
        f"max_duty allows {most:.0%}, {most * window:.3g} s: shorten its exposures, take fewer "
        "brackets, or lower rate_hz"
    ]


def longest_on(spans: Sequence[tuple[float, float]], window: float) -> float:
    """The most seconds of `spans`, ordered and disjoint, within any window of `window` seconds.

    A best window ends with a span, or begins with one: the latter is the former of the mirrored
    spans.
    """
    mirrored = [(-end, -begin) for begin, end in reversed(spans)]
    return max(_ending_with_a_span(spans, window), _ending_with_a_span(mirrored, window))


def _ending_with_a_span(spans: Sequence[tuple[float, float]], window: float) -> float:
    best, total, first = 0.0, 0.0, 0
    for begin, end in spans:
        total += end - begin
        while spans[first][1] <= end - window:
            total -= spans[first][1] - spans[first][0]
            first += 1
        cut = max(0.0, end - window - spans[first][0])
        best = max(best, total - cut)
    return best
