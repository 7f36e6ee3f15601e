"""The fit of a variant: its solvers in sequence, and the validation of their result."""

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
from appearance.inverse_rendering.batches import lit_pairs
from appearance.inverse_rendering.checkpoint import State
from appearance.inverse_rendering.correctives import solve_correctives
from appearance.inverse_rendering.global_parameters import Evidence, solve_global_parameters
from appearance.inverse_rendering.initial_absorption import absorption_of_cells
from appearance.inverse_rendering.options import InverseRenderingOptions, Variant
from appearance.inverse_rendering.problem import FitProblem, ValidationSet
from appearance.inverse_rendering.unknowns import Raw, decode, encode
from reconstruction import Progress, silent
from reconstruction.arrays import Array

COLOUR = ("sigma_a", "beta_m", "beta_n", "eta")
VARIANTS: dict[Variant, tuple[tuple[str, ...], bool]] = {
    "original": (COLOUR, False),
    "spatial": (COLOUR, True),
    "correctives": ((*COLOUR, "rotation"), True),
    "lights": ((*COLOUR, "rotation", "gain"), True),
}
"""The ablations: free parameters, and whether colour and correctives vary over the volume."""
VALIDATION_VIEWS, VALIDATION_LIGHTS = 3, 8
"""Views, and lights of each, for the global parameters."""
_ALTERNATIONS = 2
"""Alternations of global parameters and cells."""
_MORE_ROUNDS = 6
SURE, _DRAWS = 0.975, 2000
"""Least share of bootstrap draws in which a result is better than the start, and draws."""


@dataclass(frozen=True, eq=False)
class Rejected:
    """A result that was not taken, with its error."""

    maps: HairMaps
    gain: Array
    error: float


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of a fit, and its end.

    `gain (L,)` are factors on the lights' intensities. `ended` is "converged", what was kept of the
    start, or why there was nothing to fit; `start_error` and `error` are those of full images of
    all pairs, under the same new random numbers (`FitProblem.full_image_errors`). `sure` is the
    share of bootstrap draws of parts of the hair in which the result is better than the start:
    below `SURE`, maps and gain are the start's, and `rejected` is the result. `history` holds
    (seconds, validation error). `left_open`: see `global_parameters.Solved`.
    """

    maps: HairMaps
    gain: Array
    ended: str
    start_error: float
    error: float
    history: list[tuple[float, float]] = field(default_factory=list)
    sure: float = 1.0
    rejected: Rejected | None = None
    left_open: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Monitor:
    """Progress callback and checkpoint file of a fit.

    With a `checkpoint`, a killed fit resumes after its last complete solver; a file of other data
    or options is replaced. The caller removes the file.
    """

    progress: Progress = silent
    checkpoint: Path | None = None


def run(
    problem: FitProblem,
    maps: HairMaps,
    gain: Array | None = None,
    *,
    options: InverseRenderingOptions | None = None,
    monitor: Monitor | None = None,
    seed: int = 0,
) -> Outcome:
    """Fit from `maps` and the lights' factors `gain (L,)`, 1 where None.

    The result is taken if full images are clearly better with it; see `Outcome`.
    """
    gain = np.ones(len(problem.lights)) if gain is None else gain
    options = options or InverseRenderingOptions()
    return _Fit(problem, maps, gain, options, monitor or Monitor(), seed).run()


_Piece = Callable[[State, Progress], tuple[Raw, Array]]
"""A solver: from a state to unknowns, and factors on the lights' intensities."""


class _Fit:
    def __init__(
        self,
        problem: FitProblem,
        maps: HairMaps,
        gain: Array,
        options: InverseRenderingOptions,
        monitor: Monitor,
        seed: int,
    ) -> None:
        self.problem, self.options, self.monitor, self.seed = problem, options, monitor, seed
        free, self.spatial = VARIANTS[options.variant]
        self.free = [name for name in free if options.free_index or name != "eta"]
        self.start, self.gain = maps, gain
        self.first = encode(maps.resized(options.shape if self.spatial else (1, 1, 1)))
        self.used = lit_pairs(problem.views, problem.scale)
        self.spread = problem.spread(self.used, VALIDATION_VIEWS, VALIDATION_LIGHTS)
        self.history: list[tuple[float, float]] = []

    def run(self) -> Outcome:
        self.begun = time.perf_counter()
        if not self.used.any():
            unlit = "no pair of camera and light shows lit hair"
            return Outcome(self.start, self.gain, unlit, 0.0, 0.0)
        return self._judged(self._solved_pieces())

    def _record(self, raw: Raw, gain: Array, what: str, share: float) -> float:
        """Validate a guess and report its error."""
        seed = self.seed << 16
        error = self.problem.error(raw, gain, self._validation, self.options.effort, seed)
        self.history.append((time.perf_counter() - self.begun, error))
        self.monitor.progress(f"{what}: error {max(error, 0.0) ** 0.5:.4f}", share)
        return error

    def _solved_pieces(self) -> State:
        """The state after all solvers; a fit that was killed resumes from its checkpoint."""
        state = State.load(self.monitor.checkpoint, self._fingerprint)
        if state is None:
            state = State(self.first, self.gain)
            self._record(self.first, self.gain, "start", 0.0)
        else:
            self.history = state.history
            self.begun -= self.history[-1][0] if self.history else 0.0
        for k in range(state.pieces, len(self._pieces)):
            self._add_piece(state, k)
            state.history = self.history
            state.save(self.monitor.checkpoint, self._fingerprint)
        return state

    @cached_property
    def _pieces(self) -> list[tuple[str, _Piece]]:
        """The solvers: cells, global parameters, and each again; correctives."""
        solved = [name for name in self.free if name != "rotation"]
        one_colour = self.start.shape == (1, 1, 1)
        cells = self.spatial and one_colour
        # maps that differ from cell to cell come from a fit that has solved for all but the gains
        solves = solved if one_colour or "gain" in solved else []
        out: list[tuple[str, _Piece]] = []
        if cells:
            out.append(("cells", partial(self._coloured, 0)))
        for k in range((_ALTERNATIONS if cells else 1) if solves else 0):
            out.append(("global parameters", partial(self._solved, solves, k)))
            if cells:
                out.append(("cells", partial(self._coloured, 1 + k)))
        if "rotation" in self.free and not self.start.rotation.any():
            out.append(("correctives", self._turned))
        return out

    def _add_piece(self, state: State, number: int) -> None:
        what, piece = self._pieces[number]
        count, left_open = len(self._pieces), state.left_open

        def progress(what: str, share: float) -> None:
            self.monitor.progress(what, (number + share) / count)

        before = self._error_so_far(number)
        raw, gain = piece(state, progress)
        error = self._record(raw, gain, what, (number + 1) / count)
        if self._is_taken(number, error, before):
            state.raw, state.gain = raw, gain
        else:
            state.left_open = left_open
        state.pieces = number + 1

    def _is_taken(self, number: int, error: float, before: float) -> bool:
        """Whether its result is used: the first of its kind always; a repeated one, and
        correctives, if the error is lower."""
        what, *others = (name for name, _ in self._pieces[number::-1])
        return error < before or not (what == "correctives" or what in others)

    def _error_so_far(self, number: int) -> float:
        """The error of the state after the first `number` solvers."""
        taken, *errors = (error for _, error in self.history[: number + 1])
        for k, error in enumerate(errors):
            taken = error if self._is_taken(k, error, taken) else taken
        return taken

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
        return encode(maps), state.gain

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
        found = solve_correctives(self.problem, state.raw, state.gain, effort, seed=seed)
        return found.raw, state.gain

    @cached_property
    def _fingerprint(self) -> str:
        """A hash of the fit's input."""
        pieces = [what for what, _ in self._pieces]
        course = (self.options, self.seed, self.problem.scale, pieces)
        total = hashlib.sha256(repr(course).encode())
        arrays: list[NDArray[Any]] = [
            *encode(self.start).values(),
            self.gain,
            *(o.radiance for o in self.problem.views),
        ]
        for array in arrays:
            total.update(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
        return total.hexdigest()

    @cached_property
    def _validation(self) -> ValidationSet:
        start, effort = encode(self.start), self.options.effort
        return self.problem.validation(start, self.gain, self.spread, effort, self.seed << 16)

    def _judged(self, state: State) -> Outcome:
        """The best of the result and its start, under new random numbers."""
        seed, ended = (self.seed << 16) + (1 << 24), "converged"
        guesses = [(state.raw, state.gain, ended)]
        if (state.gain != self.gain).any():
            kept = f"{ended}; kept all but the intensities, which is better"
            guesses.append((self.first, state.gain, kept))
        guesses.append((self.first, self.gain, ""))
        pairs = [(raw, gain) for raw, gain, _ in guesses]
        parts = self.problem.full_image_errors(pairs, self.used, self.options.effort, seed)
        *errors, begun = (float(x.mean()) for x in parts)
        best = int(np.argmin(errors))
        raw, gain, how = guesses[best]
        maps = decode(raw)
        sure, kept = _sure(parts[-1] - parts[best]), f"{ended}; kept the start"
        # in cells, though all alike: the next variant starts from the same shape
        as_begun = self.start.resized(self.first["sigma_a"].shape[:3])
        start = Outcome(as_begun, self.gain, kept, begun, begun, self.history, sure)
        start = replace(start, left_open=state.left_open)
        if sure < SURE:
            return replace(start, rejected=Rejected(maps, gain, errors[best]))
        return replace(start, maps=maps, gain=gain, ended=how, error=errors[best])


def _sure(parts: Array) -> float:
    """Share of bootstrap draws in which the sum of `parts (B,)` is positive."""
    rng, count = np.random.default_rng(0), len(parts)
    drawn = rng.multinomial(count, np.full(count, 1 / count), _DRAWS)
    return float((drawn @ parts > 0).mean())
