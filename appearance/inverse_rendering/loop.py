"""The fit: what needs no gradient first, then steps until the validation error no longer falls."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering.batches import Batch, Pairs
from appearance.inverse_rendering.checkpoint import State
from appearance.inverse_rendering.correctives import solve_correctives
from appearance.inverse_rendering.global_parameters import WIDE, Evidence, solve_global_parameters
from appearance.inverse_rendering.initial_absorption import absorption_of_cells
from appearance.inverse_rendering.options import InverseRenderingOptions, Variant
from appearance.inverse_rendering.problem import FitProblem, Objective, ValidationSet
from appearance.inverse_rendering.unknowns import LightDeviations, Raw, decode
from reconstruction import Progress, silent
from reconstruction.arrays import Array

COLOUR = ("sigma_a", "beta_m", "beta_n", "eta")
VARIANTS: dict[Variant, tuple[tuple[str, ...], bool]] = {
    "original": (COLOUR, False),
    "spatial": (COLOUR, True),
    "correctives": ((*COLOUR, "rotation"), True),
    "lights": ((*COLOUR, "rotation", "position", "turn", "profile", "gain"), True),
}
"""The ablations: what may be free, and whether colour and correctives vary over the volume."""
PRIORS = {"position": 0.005, "turn": np.radians(2.0), "profile": 0.03, "rotation": 0.2}
"""Standard deviations about the calibration, and of correctives in radians."""
_LATEST = 0.04
"""Least weight of the latest step in the running mean, in which the steps' noise averages out; the
mean is over about the latest quarter of the steps before that (Shamir & Zhang 2013)."""
_SLOWED = 0.8
"""Share of the learning rate that the later half of the steps gives up: noise moves the end."""
_ALTERNATIONS = 2
"""Of global parameters and cells, each with what it knows of the other."""
_MORE_ROUNDS = 6
SURE, _DRAWS = 0.975, 2000
"""How often a result's whole pictures must be better than the start's, and draws of their parts."""
PRIOR_WEIGHT = 1e-3
"""Of half the mean squared prior deviation, beside the image loss."""


@dataclass(frozen=True, eq=False)
class Refused:
    """What a fit found and did not take, with its error."""

    maps: HairMaps
    lights: LightDeviations
    error: float


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a fit found, and how it came to an end.

    `ended` is "converged", "all steps taken", or why it ended early; `start_error` and `error` are
    those of whole pictures of all pairs, at the start and at the result, under fresh random numbers
    and alike for both (`FitProblem.whole_errors`). `sure` is the share of random draws of the parts
    of the hair in which the best of what was found is better than the start (bootstrap): below
    `SURE`, maps and lights are the start's, and `refused` is what was found. `history` holds
    (seconds, step, validation error). `left_open`: see `global_parameters.Solved`; empty where no
    number was solved for.
    """

    maps: HairMaps
    lights: LightDeviations
    ended: str
    start_error: float
    error: float
    steps: int
    history: list[tuple[float, int, float]] = field(default_factory=list)
    sure: float = 1.0
    refused: Refused | None = None
    left_open: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Monitor:
    """Who follows a fit, and where it saves itself.

    With a `checkpoint` file, a fit that was killed goes on where it last saved: behind cells,
    global parameters or correctives, then every few steps; a file of other data or options is
    replaced. The file stays: whoever starts the fit removes it. `snapshot` gets the CPU seconds so
    far, without validation, and the maps: as they come, and in the end.
    """

    progress: Progress = silent
    checkpoint: Path | None = None
    snapshot: Callable[[float, HairMaps], None] = lambda seconds, maps: None


def run(
    problem: FitProblem,
    maps: HairMaps,
    lights: LightDeviations | None = None,
    *,
    options: InverseRenderingOptions | None = None,
    monitor: Monitor | None = None,
    seed: int = 0,
) -> Outcome:
    """Fit from `maps` and `lights` (the calibration where None).

    What is found is taken where whole pictures are clearly better with it; see `Outcome`.
    """
    lights = LightDeviations.calibrated(len(problem.lights)) if lights is None else lights
    options = options or InverseRenderingOptions()
    return _Fit(problem, maps, lights, options, monitor or Monitor(), seed).run()


_Piece = Callable[[State, Progress], tuple[Raw, Array]]
"""What comes of a state: unknowns, and factors on the lights' intensities."""


class _Fit:
    def __init__(
        self,
        problem: FitProblem,
        maps: HairMaps,
        lights: LightDeviations,
        options: InverseRenderingOptions,
        monitor: Monitor,
        seed: int,
    ) -> None:
        self.problem, self.options, self.monitor, self.seed = problem, options, monitor, seed
        self.start, self.lights = maps, lights
        free, self.spatial = VARIANTS[options.variant]
        free = tuple(name for name in free if options.free_index or name != "eta")
        self.solves = [n for n in free if n in WIDE] if options.gauss_newton else []
        self.turns = options.gauss_newton and "rotation" in free
        kept = {"gain", "rotation"} if self.turns else {"gain"}
        self.free = [n for n in free if n not in self.solves and n not in kept]
        if self.spatial and not options.cell_start and self.solves:
            self.free.append("sigma_a")
        self.pairs = Pairs(problem.views, problem.scale, weighted=options.residual_weighted)
        self.spread = problem.spread(self.pairs, options.validation_views, options.images)
        self.series: list[tuple[float, int, float]] = []

    def run(self) -> Outcome:
        self.begun, self.worked = time.perf_counter(), time.process_time()
        if not self.pairs.used.any():
            unlit = "no pair of camera and light shows lit hair"
            return Outcome(self.start, self.lights, unlit, 0.0, 0.0, 0)
        state = self._begun()
        self.pairs.squared_error = state.tables["squared_error"]
        ended = "all steps taken" if self.free else "converged"
        while self.free and state.step < self.options.steps:
            if state.step % self.options.check_every == 0:
                self._save(state)
                share = 0.5 + 0.5 * state.step / self.options.steps
                what = f"step {state.step}"
                error = self._record(state.average, state.gain, what, share, state.step)
                if state.convergence.update(error) and self._level(state.step) == self._last_level:
                    ended = "converged"
                    break
            if reason := self._step(state):
                ended = reason
                break
        self.monitor.snapshot(time.process_time() - self.worked, decode(state.average))
        return self._judged(state, ended)

    def _record(self, raw: Raw, gain: Array, what: str, share: float, step: int = 0) -> float:
        """Validate a guess and report its error; CPU time for that does not count."""
        self.monitor.snapshot(time.process_time() - self.worked, decode(raw))
        paused = time.process_time()
        effort, seed = self.options.effort, self.seed << 16
        error = self.problem.error(raw, gain, self._validation, effort, seed)
        self.series.append((time.perf_counter() - self.begun, step, error))
        self.monitor.progress(f"{what}: error {max(error, 0.0) ** 0.5:.4f}", share)
        self.worked += time.process_time() - paused
        return error

    def _begun(self) -> State:
        """The state with which steps begin; what a fit that was killed had done is in it."""
        state = State.load(self.monitor.checkpoint, self._fingerprint)
        if state is None:
            raw = self._raw(self.start.resized(self._shape(self._level(0))))
            state = State(raw, _copied(raw), _copied(raw))
            state.tables = {"squared_error": self.pairs.squared_error, "gain": self.lights.gain}
            state.convergence.halvings = self.options.halvings
            if self._pieces:
                self._record(raw, state.gain, "start", 0.0)
        else:
            self.series = [(s, int(k), e) for s, k, e in state.history]
            self.begun -= self.series[-1][0] if self.series else 0.0
        for k in range(state.pieces, len(self._pieces)):
            self._add_piece(state, k)
            self._save(state)
        return state

    def _save(self, state: State) -> None:
        state.history = [list(point) for point in self.series]
        state.save(self.monitor.checkpoint, self._fingerprint)

    @cached_property
    def _pieces(self) -> list[tuple[str, _Piece]]:
        """What needs no gradient: cells, global parameters, and each again; correctives."""
        one_colour = self.start.shape == (1, 1, 1)
        cells = self.spatial and self.options.cell_start and one_colour
        # maps that differ from cell to cell come from a fit that has solved for all but the gains
        solves = self.solves if one_colour or "gain" in self.solves else []
        out: list[tuple[str, _Piece]] = []
        if cells:
            out.append(("cells", partial(self._coloured, 0)))
        for k in range((_ALTERNATIONS if cells else 1) if solves else 0):
            out.append(("global parameters", partial(self._solved, solves, k)))
            if cells:
                out.append(("cells", partial(self._coloured, 1 + k)))
        if self.turns and not self.start.rotation.any():
            out.append(("correctives", self._turned))
        return out

    def _add_piece(self, state: State, number: int) -> None:
        what, piece = self._pieces[number]
        count, left_open = len(self._pieces), state.left_open

        def progress(what: str, share: float) -> None:
            self.monitor.progress(what, 0.5 * (number + share) / count)

        before = self._error_so_far(number)
        raw, gain = piece(state, progress)
        error = self._record(raw, gain, what, 0.5 * (number + 1) / count)
        if self._is_taken(number, error, before):
            state.raw, state.average, state.first = raw, _copied(raw), _copied(raw)
            state.tables["gain"] = gain
        else:
            state.left_open = left_open
        state.pieces = number + 1

    def _is_taken(self, number: int, error: float, before: float) -> bool:
        """The first of its kind is; one that comes again, and correctives, where it is better."""
        what, *others = (name for name, _ in self._pieces[number::-1])
        return error < before or not (what == "correctives" or what in others)

    def _error_so_far(self, number: int) -> float:
        """Of what was taken of the start and the first `number` pieces, as they were recorded."""
        held, *errors = (error for *_, error in self.series[: number + 1])
        for k, error in enumerate(errors):
            held = error if self._is_taken(k, error, held) else held
        return held

    def _coloured(self, number: int, state: State, progress: Progress) -> tuple[Raw, Array]:
        more = {"rounds": _MORE_ROUNDS, "whole": 0} if number else {}
        maps = absorption_of_cells(
            self.problem,
            state.raw,
            state.gain,
            self.options.effort,
            seed=(self.seed << 4) + number,
            **more,
        )
        return self._raw(maps), state.gain

    def _solved(
        self, names: Sequence[str], number: int, state: State, progress: Progress
    ) -> tuple[Raw, Array]:
        evidence = Evidence(self.spread, self.options.effort, (self.seed << 4) + number)
        raw, gain, state.left_open = solve_global_parameters(
            self.problem, state.raw, state.gain, names, evidence, progress
        )
        return raw, gain

    def _turned(self, state: State, progress: Progress) -> tuple[Raw, Array]:
        effort, seed = self.options.effort, (self.seed << 4) + 15
        return solve_correctives(
            self.problem, state.raw, state.gain, effort, seed=seed
        ).raw, state.gain

    @cached_property
    def _fingerprint(self) -> str:
        """Of everything that the course of a fit depends on."""
        pieces = [what for what, _ in self._pieces]
        course = (self.options, self.seed, self.problem.scale, pieces)
        total = hashlib.sha256(repr(course).encode())
        arrays: list[NDArray[Any]] = [
            *self._raw(self.start).values(),
            self.lights.gain,
            *(o.radiance for o in self.problem.views),
        ]
        for array in arrays:
            total.update(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
        return total.hexdigest()

    def _raw(self, maps: HairMaps) -> Raw:
        return self.problem.encode(maps, self.lights)

    def _step(self, state: State) -> str | None:
        """One step; why the fit must end, if it must."""
        options = self.options
        rng = np.random.default_rng([self.seed, state.step])
        self._refine(state)
        total: Raw = {}
        for k, batch in enumerate(self._batches(rng)):
            numbers = batch.view if options.common_numbers else state.step * options.images + k
            first = (self.seed << 20) + 2 * numbers
            patch = self.problem.patch(batch, options.effort.pixels, rng)
            objective = Objective(self.free, self.series[-1][2], smooth=k == 0)
            gradient, seen = self.problem.gradient(
                state.raw, state.gain, patch, objective, options.effort, (first, first + 1)
            )
            if not all(np.isfinite(g).all() for g in gradient.values()):
                return f"step {state.step}: the gradient is not finite"
            self.pairs.update(batch, seen)
            for name, value in gradient.items():
                total[name] = total.get(name, 0.0) + value
        self._pull_to_priors(state.raw, total)
        late = max(0.0, 2 * state.step / options.steps - 1)
        scale = state.convergence.learning_rate_scale * (1 - _SLOWED * late)
        state.descent.step(state.raw, total, scale)
        state.step += 1
        share = max(_LATEST, 4 / (state.step - state.level_began + 3))
        for name, value in state.raw.items():
            state.average[name] = state.average[name] + share * (value - state.average[name])
        return None

    def _batches(self, rng: np.random.Generator) -> list[Batch]:
        images = self.options.images
        if self.options.shared_paths:
            return [self.pairs.draw(images, rng)]
        alone = [self.pairs.draw(1, rng) for _ in range(images)]
        return [replace(b, share=b.share / images) for b in alone]

    def _pull_to_priors(self, raw: Raw, gradient: Raw) -> None:
        for name, spread in PRIORS.items():
            if name in gradient:
                pull = PRIOR_WEIGHT * raw[name] / (raw[name].size * spread**2)
                gradient[name] = gradient[name] + pull

    @property
    def _last_level(self) -> int:
        return self.options.levels - 1 if self.spatial else 0

    def _level(self, step: int) -> int:
        """Coarse levels take a sixth of the steps each; cells that differ already are kept."""
        if self.options.cell_start or self.start.shape != (1, 1, 1):
            return self._last_level
        return min(step * 6 // self.options.steps, self._last_level)

    def _shape(self, level: int) -> tuple[int, int, int]:
        if not self.spatial:
            return 1, 1, 1
        layers, columns, rows = self.options.shape
        shrink = 2 ** (self._last_level - level)
        return layers, max(1, columns // shrink), max(1, rows // shrink)

    def _refine(self, state: State) -> None:
        """Go over to a finer volume when its time has come."""
        shape = self._shape(self._level(state.step))
        if state.raw["sigma_a"].shape[:3] == shape:
            return
        for raw in (state.raw, state.average):
            fine = self._raw(decode(raw).resized(shape))
            raw |= {k: fine[k] for k in ("sigma_a", "rotation")}
        for moments in (state.descent.first, state.descent.second):
            for name in ("sigma_a", "rotation"):
                moments.pop(name, None)
        state.level_began = state.step
        state.average = _copied(state.raw)

    @cached_property
    def _validation(self) -> ValidationSet:
        start, effort = self._raw(self.start), self.options.effort
        return self.problem.validation(
            start, self.lights.gain, self.spread, effort, self.seed << 16
        )

    def _judged(self, state: State, ended: str) -> Outcome:
        """The best of the result and of what it came from, by fresh random numbers."""
        effort = self.options.effort
        seed = (self.seed << 16) + (1 << 24)
        start, gain = self._raw(self.start.resized(state.first["sigma_a"].shape[:3])), state.gain
        guesses = [(state.average, gain, ended)]
        if state.step:
            guesses.append((state.first, gain, f"{ended}; kept the first maps, which are better"))
        if (gain != self.lights.gain).any():
            kept = f"{ended}; kept all but the intensities, which is better"
            guesses.append((start, gain, kept))
        guesses.append((start, self.lights.gain, ""))
        pairs = [(raw, gain) for raw, gain, _ in guesses]
        parts = self.problem.whole_errors(pairs, self.pairs.used, effort, seed)
        *errors, begun = (float(x.mean()) for x in parts)
        best = int(np.argmin(errors))
        raw, gain, how = guesses[best]
        maps, lights = decode(raw), self.problem.deviations(raw, gain)
        sure, kept = _sure(parts[-1] - parts[best]), f"{ended}; kept the start"
        # in cells, though all alike: the next variant need not tell them apart again
        as_begun = self.start.resized(start["sigma_a"].shape[:3])
        told = Outcome(as_begun, self.lights, kept, begun, begun, state.step, self.series, sure)
        told = replace(told, left_open=state.left_open)
        if sure < SURE:
            return replace(told, refused=Refused(maps, lights, errors[best]))
        return replace(told, maps=maps, lights=lights, ended=how, error=errors[best])


def _sure(parts: Array) -> float:
    """In which share of draws, with replacement, the sum of `parts (B,)` is positive."""
    rng, count = np.random.default_rng(0), len(parts)
    drawn = rng.multinomial(count, np.full(count, 1 / count), _DRAWS)
    return float((drawn @ parts > 0).mean())


def _copied(raw: Raw) -> Raw:
    return {k: v.copy() for k, v in raw.items()}
