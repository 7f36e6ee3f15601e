"""Inverse rendering stage by stage; each is kept or dropped by frames that took no part."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering.batches import Batch, lit_pairs
from appearance.inverse_rendering.checkpoint import State
from appearance.inverse_rendering.correctives import solve_correctives
from appearance.inverse_rendering.global_parameters import Evidence, solve_global_parameters
from appearance.inverse_rendering.held_out import Split
from appearance.inverse_rendering.initial_absorption import absorption_of_cells
from appearance.inverse_rendering.lobes import (
    as_calibrated,
    determined,
    mean_level,
    solve_lobes,
    with_lobes,
    without_axis,
)
from appearance.inverse_rendering.options import InverseRenderingOptions
from appearance.inverse_rendering.problem import FitProblem
from appearance.inverse_rendering.unknowns import Raw, decode, encode
from appearance.metrics.decision import MATERIAL, Decision, Material, decide
from reconstruction import Progress, silent
from reconstruction.arrays import Array, Bools, Ints
from reconstruction.geometry.lights import LightPattern

SHARED_VIEWS, SHARED_LIGHTS = 3, 8
"""Views, and lights of each, for the global parameters."""
LOBE_ROUNDS = 2
"""Times that the lights' lobes are solved for, and the hair under them."""
HELD_LIGHTS = 4
"""Lights that are held out, at most."""
LEAST_PIXELS = 1.0
"""Hair pixels of all views for each cell of the volume, below which no cell is fitted."""
GOOD = 0.005
"""Error in displayed values that no stage is run to lower."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of a fit.

    `gain (L,)` are factors on the lights' intensities; `decisions` has one for each stage.
    `left_open`: see `global_parameters.Solved`. `lobes (L, 6)`: see `lobes.as_calibrated`, None
    where no axis was looked for.
    """

    maps: HairMaps
    gain: Array
    decisions: list[Decision] = field(default_factory=list)
    left_open: dict[str, float] = field(default_factory=dict)
    lobes: Array | None = None

    @property
    def kept(self) -> list[str]:
        """The stages that were kept."""
        return [x.stage for x in self.decisions if x.kept]


@dataclass(frozen=True)
class Monitor:
    """Progress callback and checkpoint file of a fit.

    With a `checkpoint`, a killed fit resumes after its last complete stage; a file of other data
    or options is replaced. The caller removes the file.
    """

    progress: Progress = silent
    checkpoint: Path | None = None


def run(
    problem: FitProblem,
    maps: HairMaps,
    gain: Array | None = None,
    *,
    stages: Sequence[Material] = MATERIAL,
    options: InverseRenderingOptions | None = None,
    held_lights: int | None = None,
    monitor: Monitor | None = None,
    seed: int = 0,
) -> Outcome:
    """Fit from `maps` and the lights' factors `gain (L,)`, 1 where None.

    `held_lights` lights, by default a quarter and at most four, and one view of four or more are
    held out. A stage starts from the last that was kept, and is kept if `decide` finds the error of
    the held-out frames lower.
    """
    gain = np.ones(len(problem.lights)) if gain is None else gain
    if held_lights is None:
        held_lights = min(HELD_LIGHTS, len(problem.lights) // 4)
    fit = _Fit(problem, options or InverseRenderingOptions(), held_lights, seed)
    return fit.run(maps, gain, stages, monitor or Monitor())


class _Fit:
    def __init__(
        self, problem: FitProblem, options: InverseRenderingOptions, held_lights: int, seed: int
    ) -> None:
        self.problem, self.options, self.seed = problem, options, seed
        self.split = Split.of(problem, held_lights)
        self.training, self.lights = self.split.training, self.split.lights
        colour = ("sigma_a", "beta_m", "beta_n", "eta")
        self.colour = [name for name in colour if options.free_index or name != "eta"]
        self._judged: tuple[Array, Array] | None = None
        """`_squares` of what was kept last, once it is known."""

    def run(
        self, maps: HairMaps, gain: Array, stages: Sequence[Material], monitor: Monitor
    ) -> Outcome:
        start = State(encode(maps), gain)
        fingerprint = self._fingerprint(start, stages)
        state = State.load(monitor.checkpoint, fingerprint) or start
        count = len(stages)
        for k in range(len(state.decisions), count):

            def progress(what: str, share: float, stage: str = stages[k], k: int = k) -> None:
                monitor.progress(f"{stage}: {what}", (k + share) / count)

            self._add(stages[k], state, progress)
            state.save(monitor.checkpoint, fingerprint)
            monitor.progress(str(state.decisions[-1]), (k + 1) / count)
        found = state.left_open, state.lobes
        return Outcome(decode(state.raw), state.gain, state.decisions, *found)

    def _add(self, stage: Material, state: State, progress: Progress) -> None:
        if reason := self._skipped(stage, state):
            state.decisions.append(Decision(stage, skipped=reason))
            return
        begun = time.perf_counter()
        progress("fitting", 0.0)
        raw, gain, left_open, *lobes = self._solvers[stage](state.raw, state.gain, progress)
        progress("rendering held-out frames", 0.9)
        state.lobes = lobes[0] if lobes else state.lobes
        lit, frames, shown = self.problem, self.split.held_out, gain
        turned = bool(lobes) and bool(np.isfinite(lobes[0][:, 3]).any())
        if turned:
            lit = self.problem.under(with_lobes(self.problem.lights, lobes[0]))
            self._judged, frames = None, frames | self.split.frames_of_fitted()
            own = (gain / state.gain)[self.lights]
            level = mean_level(self.training, lobes[0][self.lights], own)
            shown = gain.copy()
            shown[self._held_lights] *= level
        before = self._judged or self._squares(self.problem, state.raw, state.gain, frames)
        after = self._squares(lit, raw, shown, frames)
        decision = decide(stage, before[0], after[0], before[1], time.perf_counter() - begun)
        state.decisions.append(decision)
        if not turned:
            self._judged = after if decision.kept else before
        if decision.kept:
            state.raw, state.gain = raw, gain
            state.left_open = left_open or state.left_open
            if turned:
                self._add_lobes_of_held_out(state, level)
        elif state.lobes is not None:
            state.lobes[:, :4] = np.nan

    def _squares(
        self, problem: FitProblem, raw: Raw, gain: Array, frames: Bools
    ) -> tuple[Array, Array]:
        seed = (self.seed << 16) + (1 << 24)
        return problem.squares(raw, gain, frames, self.options.effort, seed)

    def _skipped(self, stage: Material, state: State) -> str:
        """Why a stage cannot pay for its cost; empty if it may."""
        views, cells = self.training.views, int(np.prod(self.options.shape))
        pixels = sum(len(o.pixels) for o in views)
        errors = [
            ((x.after if x.kept else x.before) or 0.0) + (x.standard_error or np.inf)
            for x in state.decisions
            if not x.skipped
        ]
        if not self.split.fitted.any():
            return "no pair of camera and light shows lit hair"
        if not self.split.held_out.any():
            return f"no frame can be held out of {len(views)} x {len(self.lights)}"
        if stage in ("spatial", "correctives") and pixels < LEAST_PIXELS * cells:
            return f"{pixels} hair pixels are too few for {cells} cells"
        if stage == "lights" and any(isinstance(x, LightPattern) for x in self.problem.lights):
            return "patterns do not separate the lights' intensities"
        if stage == "lights" and len(views) < 2:
            return "one camera cannot separate a light's intensity from the hair's colour"
        if errors and errors[-1] < GOOD:
            return f"the error on held-out frames is under {GOOD} already"
        return ""

    @property
    def _solvers(self) -> dict[Material, _Solver]:
        return {
            "shared": self._shared,
            "spatial": self._spatial,
            "correctives": self._correctives,
            "lights": self._lights,
        }

    def _shared(
        self,
        raw: Raw,
        gain: Array,
        progress: Progress,
        names: Sequence[str] = (),
        lobes: Array | None = None,
    ) -> _Solved:
        """`names`, by default roughness and colour, solved for; of fitted lights with `lobes`."""
        training, fitted = self.training, self.split.fitted
        if lobes is not None:
            training = training.under(with_lobes(training.lights, lobes))
            fitted = fitted & ~self.split.left_out
        pairs = training.spread(fitted, SHARED_VIEWS, SHARED_LIGHTS)
        evidence = Evidence(pairs, self.options.effort, self.seed << 4)
        raw, of_lights, left_open = solve_global_parameters(
            training, raw, gain[self.lights], names or self.colour, evidence, progress
        )
        gain = gain.copy()
        gain[self.lights] = of_lights
        return raw, gain, left_open

    def _spatial(self, raw: Raw, gain: Array, progress: Progress) -> _Solved:
        effort, seed = self.options.effort, self.seed << 4
        raw = self._in_cells(raw)
        maps = absorption_of_cells(self.training, raw, gain[self.lights], effort, seed=seed)
        return encode(maps), gain, {}

    def _correctives(self, raw: Raw, gain: Array, progress: Progress) -> _Solved:
        effort, seed = self.options.effort, (self.seed << 4) + 15
        raw = self._in_cells(raw)
        found = solve_correctives(self.training, raw, gain[self.lights], effort, seed=seed)
        return found.raw, gain, {}

    def _lights(self, raw: Raw, gain: Array, progress: Progress) -> Any:
        names = [*self.colour, "gain"]
        left_open: dict[str, float] = {}
        if not any(map(without_axis, self.training.lights)):
            raw, gain, left_open = self._shared(raw, gain, progress, names)
            if np.ptp(raw["sigma_a"], axis=(0, 1, 2)).any():
                # cells that were fitted with another roughness
                raw = self._spatial(raw, gain, progress)[0]
            return raw, gain, left_open
        pairs = _pairs(self.split.fitted & ~self.split.left_out)
        lobes, start = as_calibrated(len(gain)), gain
        for k in range(LOBE_ROUNDS):
            found, factors = self._solve_lobes(self.training, raw, pairs, k)
            gain = start.copy()
            gain[self.lights] *= factors
            raw, gain, left_open = self._shared(raw, gain, progress, names, found)
            lobes[self.lights] = found
            if not np.isfinite(found[:, 3]).any():
                break
        lobes, gain = determined(self.problem, lobes, gain)
        return raw, gain, left_open, lobes

    def _solve_lobes(
        self, problem: FitProblem, raw: Raw, pairs: Any, k: int
    ) -> tuple[Array, Array]:
        options, seed = self.options, (self.seed << 4) + k
        return solve_lobes(problem, raw, pairs, options.effort, seed, options.light_power)

    def _add_lobes_of_held_out(self, state: State, level: float) -> None:
        """Those of the lights that were held out, on the hair that was kept; a factor of `level`
        where none is found."""
        assert state.lobes is not None
        rest = self._held_lights
        lit = lit_pairs(self.problem.views, self.problem.scale)
        lit[:, self.lights] = False
        found = self._solve_lobes(self.problem, state.raw, _pairs(lit), 7)
        lobes, factors = determined(self.problem, *found)
        state.lobes[rest], state.gain = lobes[rest], state.gain.copy()
        solved = np.isfinite(found[0][rest, 3])
        state.gain[rest] *= np.where(solved, factors[rest], level)

    @property
    def _held_lights(self) -> Ints:
        return np.delete(np.arange(len(self.problem.lights)), self.lights)

    def _in_cells(self, raw: Raw) -> Raw:
        return encode(decode(raw).resized(self.options.shape))

    def _fingerprint(self, start: State, stages: Sequence[Material]) -> str:
        """A hash of the fit's input."""
        course = (self.options, self.seed, self.problem.scale, stages, self.lights.tolist())
        total = hashlib.sha256(repr(course).encode())
        arrays: list[NDArray[Any]] = [*start.raw.values(), start.gain]
        for array in [*arrays, *(o.radiance for o in self.problem.views)]:
            total.update(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
        return total.hexdigest()


def _pairs(used: Bools) -> list[Batch]:
    """The pairs `used (V, L)`, by view."""
    return [Batch(v, np.flatnonzero(row)) for v, row in enumerate(used) if row.any()]


_Solved = tuple[Raw, Array, dict[str, float]]
_Solver = Callable[[Raw, Array, Progress], Any]
"""Solves a stage: fitted unknowns, factors on the lights' intensities, `Solved.left_open`, and
lobes if they were looked for."""
