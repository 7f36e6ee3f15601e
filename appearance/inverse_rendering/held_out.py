"""The frames of a fit that decide which of its stages are kept."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from appearance.inverse_rendering.batches import lit_pairs
from appearance.inverse_rendering.problem import FitProblem
from appearance.observations import far_apart
from reconstruction.arrays import Bools, Ints

FEWEST_VIEWS = 4
"""Fewest views to hold one out."""


@dataclass(frozen=True, eq=False)
class Split:
    """The `views` and `lights` of `problem` that are fitted; `training` has only them.

    `fitted (V', L')` are the pairs of `training` that show lit hair, `held_out (V, L)` those of
    `problem` that take no part: every pair of a view or a light that is not fitted.
    """

    problem: FitProblem
    training: FitProblem
    lights: Ints
    fitted: Bools
    held_out: Bools

    @classmethod
    def of(cls, problem: FitProblem, count: int) -> Split:
        """`count` of the lights are held out, and one view of four or more."""
        views, lights = np.arange(len(problem.views)), np.arange(len(problem.lights))
        if len(views) >= FEWEST_VIEWS:
            views = np.delete(views, len(views) // 2)
        order = far_apart(np.array([x.position for x in problem.lights]), len(lights))
        lights = np.sort(order[: len(lights) - count])
        lit = lit_pairs(problem.views, problem.scale)
        fitted, held_out = np.ix_(views, lights), lit.copy()
        held_out[fitted] = False
        return cls(problem, problem.part(views, lights), lights, lit[fitted], held_out)

    @property
    def left_out(self) -> Bools:
        """Of `fitted`, the frames `(V', L')` that the lights' lobes are not fitted to: none if a
        view is held out, else of each light those of one view."""
        views, lights = self.fitted.shape
        of = np.arange(views)[:, None] == np.arange(lights) % max(views, 1)
        return np.asarray(of & (len(self.problem.views) < FEWEST_VIEWS) & self.fitted)

    def frames_of_fitted(self) -> Bools:
        """The frames `(V, L)` of fitted lights that their lobes are not fitted to."""
        out = np.zeros_like(self.held_out)
        out[:, self.lights] = self.held_out[:, self.lights]
        if len(self.problem.views) < FEWEST_VIEWS:
            out[:, self.lights] |= self.left_out
        return out
