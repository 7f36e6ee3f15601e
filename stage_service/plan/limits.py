"""`[safety]` limits and levels of a plan: checked before anything is lit."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence

from reconstruction import Rig
from stage_service.config import PROJECTOR_LEVELS, SafetyLimits
from stage_service.device_config import LightBankConfig
from stage_service.plan.stepping import Run
from stage_service.plan.timeline import Lit

PROJECTORS = PROJECTOR_LEVELS, "projector controller"


def check_limits(lights: Iterable[Lit], rig: Rig, limits: SafetyLimits) -> list[str]:
    """One sentence for each limit that the plan exceeds, its worst case; without retries."""
    steps = [x for x in lights if x.step.kind in ("olat", "all_on")]
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
    lamps = {x.step.kind: len(rig.lights) if x.step.kind == "all_on" else 1 for x in steps}
    for kind, count in lamps.items():
        if limits.max_lamps is not None and count > limits.max_lamps:
            problems.append(
                f"{kind}: {count} lamps would be lit at once; [safety] max_lamps allows "
                f"{limits.max_lamps}: leave the sentinels out (sentinels = false)"
            )
        level = max(x.step.level for x in steps if x.step.kind == kind)
        power = count * level * limits.lamp_power_w
        if limits.max_power_w is not None and power > limits.max_power_w:
            most = limits.max_power_w / (count * limits.lamp_power_w)
            problems.append(
                f"level.{kind}: {count} lamps at level {level:g} draw {power:.4g} W; [safety] "
                f"max_power_w allows {limits.max_power_w:g} W: at most level {most:.3g}"
            )
    if limits.max_duty < 1:
        problems += _check_duty(steps, rig, limits)
    return problems


def check_levels(parts: Iterable[Run], bank: LightBankConfig) -> list[str]:
    """One sentence for each kind of step whose level the device would round to another, or to 0."""
    problems = {}
    for part in parts:
        lamps = bank.level_steps(by_table=part.stepping == "hardware")
        for step in part.steps:
            if step.kind == "dark":
                continue
            of_lamps = step.kind in ("olat", "all_on")
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


def _check_duty(steps: Sequence[Lit], rig: Rig, limits: SafetyLimits) -> list[str]:
    window, most = limits.duty_window_s, limits.max_duty
    spans: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for lit in steps:
        names = [x.name for x in rig.lights] if lit.step.light is None else [lit.step.light]
        for name in names:
            spans[name].append((lit.at, lit.at + lit.seconds))
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
