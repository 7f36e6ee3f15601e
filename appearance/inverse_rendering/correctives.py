"""Rotation correctives: a rotation of each cell's fibres, fitted to first-hit light.

First-hit light depends most on rotations and has little noise. Its paths depend on the geometry
only: they are drawn once, and Gauss-Newton on them has exact derivatives. Indirect light is
rendered, smoothed over a pixel and held fixed. Frames under validation lights select the step
size, because systematic errors over many lights and pixels can be overfitted like noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering import losses
from appearance.inverse_rendering.batches import Patch
from appearance.inverse_rendering.linearised import LinearisedPictures
from appearance.inverse_rendering.options import Effort
from appearance.inverse_rendering.problem import DirectLight, FitProblem, direct_spp
from appearance.inverse_rendering.unknowns import MOST_TURN, Raw, decode, encode_rotation
from reconstruction.arrays import Array, Ints

WIDTH = 0.2
"""Prior standard deviation of a corrective, radians."""
PRIOR_WEIGHT = 1e-3
"""Weight of half the mean squared corrective, in widths."""
_TURNS, _ITERATIONS = 2, 30
_APART = 4
"""One light of this many is a validation light."""
_SHARES = (2.0, 1.0, 0.5)
"""Step sizes; noise in the derivatives makes steps too short."""
_ALIKE = 1e-4
"""Squared radians below which layers count as alike."""


@dataclass(frozen=True)
class Correctives:
    """The unconstrained numbers `raw`, and the error under the validation lights.

    `taken` are the step sizes; empty, with `raw` unchanged, if no step reduces the error.
    """

    raw: Raw
    taken: tuple[float, ...]
    error: float
    start_error: float


def solve_correctives(
    problem: FitProblem,
    raw: Raw,
    gain: Array,
    effort: Effort,
    *,
    lambda_r: float = losses.LAMBDA_R,
    seed: int = 0,
) -> Correctives:
    """`raw` with correctives for the cells of its volume, at `gain (L,)`.

    `lambda_r` weights the mean difference between layers and between neighbours on the scalp, where
    reconstructed strands have similar errors.
    """
    lights = np.arange(len(problem.lights))
    judge = lights % _APART == _APART - 1
    if not judge.any():
        return Correctives(raw, (), 0.0, 0.0)
    depth_one = replace(effort, spp=direct_spp(sum(len(o.pixels) for o in problem.views)))
    rest = [problem.indirect(raw, gain, k, effort, seed + k) for k in range(len(problem.views))]
    fitted, judging = (
        [
            _View(problem, problem.direct(raw, gain, patch, depth_one, seed + 100 + k), rest[k])
            for k, patch in enumerate(_patches(problem, chosen))
        ]
        for chosen in (lights[~judge], lights[judge])
    )
    maps = decode(raw)
    start_error = error = _error(judging, maps)
    taken: list[float] = []
    for _ in range(_TURNS):
        step = _step(fitted, maps, lambda_r)
        tried = []
        for share in _SHARES:
            rotation = np.clip(maps.rotation + share * step, -0.9 * MOST_TURN, 0.9 * MOST_TURN)
            there = replace(maps, rotation=rotation)
            tried.append((_error(judging, there), share, there))
        least = min(tried, key=lambda x: x[0])
        if not least[0] < error:
            break
        error, maps = least[0], least[2]
        taken.append(least[1])
    found = raw | {"rotation": encode_rotation(maps.rotation)} if taken else raw
    return Correctives(found, tuple(taken), error, start_error)


class _View:
    """One view under some lights: captured and indirect light, and the paths of direct light."""

    def __init__(self, problem: FitProblem, direct: DirectLight, rest: Array) -> None:
        self.problem, self.direct = problem, direct
        self.rest = rest[direct.patch.lights]
        self.weight: Array | None = None

    def pictures(self, maps: HairMaps, derivatives: bool) -> tuple[LinearisedPictures, Array]:
        """First-hit light, and the difference of all light `(2, L, P, 3)`."""
        pictures = self.direct.linearised(maps, ("rotation",) if derivatives else ())
        halves = pictures.picture() + self.rest
        compared = self.problem.compare(self.direct.patch, halves.mean(axis=0))
        off = halves - compared.captured
        if self.weight is None:
            # fixed at the start: later weights would select noise
            weight = np.where(compared.valid[..., None], losses.weights(compared.level), 0)
            self.weight = losses.noise_weighted(weight, off[0] * off[0], compared.level)
        return pictures, off


def _patches(problem: FitProblem, lights: Ints) -> list[Patch]:
    """All pixels of all views under `lights`."""
    return [Patch(k, lights, np.arange(len(o.pixels))) for k, o in enumerate(problem.views)]


def _error(views: list[_View], maps: HairMaps) -> float:
    """Weighted mean squared difference, without the noise of the rendered side."""
    total, count = 0.0, 0
    for view in views:
        _, off = view.pictures(maps, False)
        assert view.weight is not None
        total += float((view.weight * off[0] * off[1]).sum())
        count += view.weight.size
    return total / max(count, 1)


def _step(views: list[_View], maps: HairMaps, lambda_r: float) -> Array:
    """The Gauss-Newton step of the correctives `(n_c, w, h, 2)`."""
    shape, x = maps.shape, maps.rotation
    parts, moment, error, count = [], np.zeros(x.shape), 0.0, 0
    for view in views:
        pictures, off = view.pictures(maps, True)
        assert view.weight is not None
        # derivative and difference are of different halves of the paths: their noise is independent
        moment += pictures.rotation_gradient(0.5 * view.weight * off[::-1], shape)
        error += float((view.weight * off[0] * off[1]).sum())
        count += view.weight.size
        parts.append((pictures, 0.5 * view.weight))
    # the image loss is the root of the mean square
    scale = 1 / (max(count, 1) * max(error / max(count, 1), losses.LEAST_ERROR**2) ** 0.5)
    prior = PRIOR_WEIGHT / (x.size * WIDTH**2)
    # |d| as a parabola with its derivative at the present d
    stiff = [
        lambda_r / between.size / np.sqrt(between**2 + _ALIKE) if between.size else between
        for between in (np.diff(x, axis=axis) for axis in range(3))
    ]

    def pulled(v: Array) -> Array:
        out = prior * v
        for axis, of_axis in enumerate(stiff):
            # minus the divergence of the force between neighbours
            ends = [(1, 1) if k == axis else (0, 0) for k in range(4)]
            out -= np.diff(np.pad(of_axis * np.diff(v, axis=axis), ends), axis=axis)
        return out

    def normal(flat: Array) -> Array:
        v = flat.reshape(x.shape)
        out = pulled(v)
        for pictures, weight in parts:
            mean = pictures.change({"rotation": v}, first_hit=True).mean(axis=0)
            both = np.stack([weight * mean] * 2)
            out = out + scale * pictures.rotation_gradient(both, shape)
        return np.asarray(out.ravel())

    operator = LinearOperator((x.size, x.size), matvec=normal, dtype=float)
    found, _ = cg(operator, -(scale * moment + pulled(x)).ravel(), rtol=0.02, maxiter=_ITERATIONS)
    return np.asarray(found.reshape(x.shape))
