"""Patterns of a plan, and the level of each lamp in a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import count

import numpy as np

from reconstruction import Rig, Step
from reconstruction.arrays import Array
from reconstruction.capture.light_patterns import LightPatterns, PatternError
from stage_service.config import RigFile
from stage_service.plan.capture_plan import CapturePlan

LAMP_KINDS = ("olat", "all_on", "pattern")
"""Kinds of steps that light lamps."""


class LampLevels:
    """The level of each lamp of a `rig` in a step of a plan with these `patterns`."""

    def __init__(self, rig: Rig, patterns: LightPatterns | None) -> None:
        self._place = {light.name: i for i, light in enumerate(rig.lights)}
        self._weights: dict[str, Array] = {}
        if patterns is not None:
            lit = [self._place[name] for name in patterns.lights]
            for name, row in zip(patterns.names, patterns.weights, strict=True):
                self._weights[name] = np.zeros(len(self._place))
                self._weights[name][lit] = row

    def __call__(self, step: Step) -> Array:
        """Levels `(L,)`, 0 to 1, in the order of the rig."""
        if step.kind == "pattern":
            return step.level * self._weights[str(step.pattern)]
        levels = np.zeros(len(self._place))
        if step.light is not None:
            levels[self._place[step.light]] = step.level
        elif step.kind == "all_on":
            levels[:] = step.level
        return levels


def level_of_bank(level: float, rig_file: RigFile) -> float:
    """The level that the light bank makes of `level`; itself where that would be dark."""
    steps = _level_steps(rig_file)
    return level if steps in (None, 1) else round(level * steps) / steps or level


def patterns_of(plan: CapturePlan, rig_file: RigFile, level: float) -> LightPatterns | None:
    """The patterns of a plan as the light bank makes them at `level`, which it has.

    Their weights are rounded to its levels, so that the capture records the light that was there.
    Raises `PatternError`.
    """
    if plan.patterns is None:
        return None
    rig = rig_file.rig
    chosen = [x.name for x in rig.lights] if plan.lights == "all" else list(plan.lights)
    if not chosen:
        raise PatternError("the plan has no lights: leave 'lights' out, or name some")
    if plan.patterns == "s_matrix":
        found = _numbered(chosen, s_matrix(len(chosen)))
    elif plan.patterns == "gradients":
        found = gradients(rig, chosen)
    else:
        table = plan.patterns.items()
        rows = {n: r if isinstance(r, dict) else dict.fromkeys(r, 1.0) for n, r in table}
        found = LightPatterns.of_table(rows, [x.name for x in rig.lights])
        if others := [x for x in found.lights if x not in chosen]:
            raise PatternError(f"they light {others[0]!r}, which 'lights' excludes")
    steps = _level_steps(rig_file)
    return found if steps is None else _rounded(found, level, steps)


def s_matrix(lights: int) -> Array:
    """Weights `(P, lights)` of 0 and 1 that determine each light: columns of a cyclic S-matrix.

    P is the least prime 4 k + 3 from `lights` on; its quadratic residues give the rows, each with
    (P + 1) / 2 lights of P. Noise of reading is 2 √P / (P + 1) that of a light alone (Harwit and
    Sloane, Hadamard Transform Optics, 1979; Schechner et al., IEEE TPAMI 29(8), 2007).
    """
    order = next(n for n in count(3, 4) if n >= lights and all(n % k for k in range(3, n, 2)))
    residues = [i * i % order for i in range(order)]
    row = np.isin(np.arange(order), residues)
    return np.array([np.roll(row, -i)[:lights] for i in range(order)], float)


def gradients(rig: Rig, lights: Sequence[str]) -> LightPatterns:
    """All `lights`, and weights (1 ± d) / 2 of their directions d from the head's centre along x, y
    and z (Ma et al., EGSR 2007; the inverse ones: Wilson et al., ACM TOG 29(2), 2010)."""
    places = np.array([rig.light(name).position for name in lights])
    along = (places / np.linalg.norm(places, axis=1, keepdims=True)).T
    weights = np.clip([np.ones(len(lights)), *(1 + along) / 2, *(1 - along) / 2], 0, 1)
    names = ("full", "x", "y", "z", "x_inverse", "y_inverse", "z_inverse")
    return LightPatterns(names, tuple(lights), weights)


def _numbered(lights: Sequence[str], weights: Array) -> LightPatterns:
    lit = weights[weights.any(axis=1)]
    return LightPatterns(tuple(f"s_{i:03d}" for i in range(len(lit))), tuple(lights), lit)


def _level_steps(rig_file: RigFile) -> int | None:
    return None if rig_file.devices is None else rig_file.devices.lights.level_steps()


def _rounded(patterns: LightPatterns, level: float, steps: int) -> LightPatterns:
    """Weights that the bank has at `level`. Raises `PatternError` where it has on and off alone."""
    if steps == 1 and (grey := (patterns.weights % 1 != 0).any(axis=1)).any():
        name = patterns.names[int(np.flatnonzero(grey)[0])]
        raise PatternError(
            f"{name} has weights between 0 and 1, and the light bank of [devices.lights] has no "
            "levels: use weights of 0 and 1, as s_matrix has"
        )
    full = round(level * steps) or steps
    weights = np.round(patterns.weights * full) / full
    if (dark := ~weights.any(axis=1)).any():
        name = patterns.names[int(np.flatnonzero(dark)[0])]
        raise PatternError(f"{name} would be dark at level {level:g}: raise level.pattern")
    return replace(patterns, weights=weights)
