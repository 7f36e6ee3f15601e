"""Axes and power of near lights' cosine lobes, from images of the hair.

A lobe varies the light over the head: its gradient gives the product of power and tilt, and its
curvature and the differences of level between lights separate the two. One rendering is an image
under any lobes, times their ratio at each pixel's hit, so that Gauss-Newton repeats no rendering.
As for the global parameters, instruments are free of the renderings' noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from appearance.inverse_rendering.batches import Batch, Patch
from appearance.inverse_rendering.losses import FLOOR, noise_weighted
from appearance.inverse_rendering.options import Effort
from appearance.inverse_rendering.problem import FitProblem
from appearance.inverse_rendering.unknowns import Raw
from reconstruction import Light
from reconstruction.arrays import Array, Ints
from reconstruction.geometry.cameras import facing
from reconstruction.geometry.light_profiles import cosine_lobe
from reconstruction.geometry.lights import Lighting

DETERMINED = np.radians(5.0)
"""Standard error of an axis above which its light stays as calibrated."""
LAMBERTIAN, MOST_POWER, _MOST_ASIDE = 1.0, 50.0, 2.0
"""Power that the fit begins with, its limit, and that of the tangent of axis to hair."""
_WIDE = np.array([1.0, 1.0, 1.0, 1.0, 0.03, 0.5, 0.5])
"""Prior standard deviations: of the hair's brightness (none), the power, and of each light its log
intensity and the angles (radians) of its axis from the hair."""
_MODEL = 0.01
"""Relative error of renderings, alike in each of `_PARTS`: strands and skin are not exact."""
_KNOWN = 1e-6
"""Prior standard deviation of a power that is given."""
_HALVINGS = 4
"""Of a step after which the error is twice as large: the far side of a lobe is dark."""
_PARTS = 3
"""Of a view's pixels, in image order. Errors of the strands are alike over a large part of a view:
single rows, taken as independent, made axes of isotropic lights significant."""
_STEPS, _MOST_STEP, _PATHS, _SPP = 20, 0.4, 1 << 22, 16


def as_calibrated(count: int) -> Array:
    """The `lobes (L, 6)` of lights as calibrated: NaN.

    Columns are a unit axis, the power, and the standard errors of the axis, in radians, and power.
    """
    return np.full((count, 6), np.nan)


def with_lobes(lights: Sequence[Lighting], lobes: Array) -> list[Lighting]:
    """`lights` (L) with `lobes (L, 6)`, and their intensities as calibrated on the axis."""
    return [
        replace(x, orientation=facing(row[:3]), profile=cosine_lobe(float(row[3])))
        if isinstance(x, Light) and np.isfinite(row[3])
        else x
        for x, row in zip(lights, lobes, strict=True)
    ]


def without_axis(light: Lighting) -> bool:
    """Whether the calibration of a light has no axis."""
    return isinstance(light, Light) and light.orientation is None


def paths_a_pixel(pixels: int, effort: Effort) -> int:
    """Of `solve_lobes`, for views of so many `pixels` in total; an eighth of them come first."""
    return int(np.clip(_PATHS // max(pixels, 1), 1, _SPP * effort.spp))


def solve_lobes(
    problem: FitProblem,
    raw: Raw,
    pairs: Sequence[Batch],
    effort: Effort,
    seed: int = 0,
    power: float | None = None,
) -> tuple[Array, Array]:
    """Lobes `(L, 6)` and factors `gain (L,)` of the lights of `pairs` without an axis.

    The lights have one power, fitted if `power` is None. The hair is as `raw` has it but for a
    factor in each channel. If no axis is determined, all lights are as calibrated, with the errors.
    Takes the time of two images of at most 16 `effort.spp` paths a pixel.
    """
    lobes, gain = as_calibrated(len(problem.lights)), np.ones(len(problem.lights))
    lit = {int(i) for b in pairs for i in b.lights}
    free = sorted(i for i in lit if without_axis(problem.lights[i]))
    if not free:
        return lobes, gain
    pixels = sum(len(problem.views[b.view].pixels) for b in pairs)
    spp = paths_a_pixel(pixels, effort)
    now = prior = _Lobes.facing_hair(problem, free, LAMBERTIAN if power is None else power)
    wide = np.concatenate([_WIDE[:4], np.tile(_WIDE[4:], len(free))])
    wide[3] = wide[3] if power is None else _KNOWN
    for k, paths in enumerate((max(1, spp // 8), max(1, spp // 2))):
        images = _images(problem, raw, pairs, now, replace(effort, spp=paths), seed + k, bool(k))
        now, error = _solve(problem, now, prior, wide, images)
        if error[:, 0].min() > 3 * DETERMINED:
            break
    lobes[free] = np.column_stack([now.axes, np.full(len(free), now.power), error])
    gain[free] = np.exp(now.log_gain)
    if not (error[:, 0] < DETERMINED).any():
        lobes[:, :4], gain[free] = np.nan, 1.0
    return lobes, gain


def determined(problem: FitProblem, lobes: Array, gain: Array) -> tuple[Array, Array]:
    """`lobes (L, 6)` without axis and power where the axis' error is above `DETERMINED`, and
    `gain (L,)` with what those lobes send towards the hair's centre."""
    lobes, gain = lobes.copy(), gain.copy()
    vague = np.isfinite(lobes[:, 3]) & ~(lobes[:, 4] < DETERMINED)
    gain[vague] *= towards_hair(problem, lobes)[vague]
    lobes[vague, :4] = np.nan
    return lobes, gain


def towards_hair(problem: FitProblem, lobes: Array) -> Array:
    """Share `(L,)` of its light on the axis that each of `lobes (L, 6)` sends to the hair's centre;
    1 as calibrated."""
    ahead = problem.centre - np.array([x.position for x in problem.lights])
    cosine = (ahead * lobes[:, :3]).sum(axis=1) / np.linalg.norm(ahead, axis=1)
    return np.where(np.isfinite(lobes[:, 3]), np.maximum(cosine, 0.0) ** lobes[:, 3], 1.0)


def mean_level(problem: FitProblem, lobes: Array, gain: Array) -> float:
    """Geometric mean of what lights with `lobes (L, 6)` and factors `gain (L,)` send to the hair's
    centre, over what they send as calibrated: the best guess for a light that was not fitted."""
    level = np.maximum(gain * towards_hair(problem, lobes), 1e-3)
    return float(np.exp(np.log(level).mean()))


@dataclass(frozen=True, eq=False)
class _Lobes:
    """Of the n lights number `free`: `log_gain (n,)`, `axes (n, 3)`, and the `power` of all."""

    free: list[int]
    log_gain: Array
    axes: Array
    power: float

    @classmethod
    def facing_hair(cls, problem: FitProblem, free: list[int], power: float) -> _Lobes:
        ahead = problem.centre - np.array([problem.lights[i].position for i in free])
        axes = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
        return cls(free, np.zeros(len(free)), axes, power)

    def share(self, problem: FitProblem, k: int, points: Array) -> tuple[Array, Array]:
        """The lobe of light `k` of `free` towards `points (N, 3)`, and the derivatives `(4, N)` of
        its logarithm by power, log gain, and turns of the axis to the right and down."""
        frame = facing(self.axes[k])
        local = (points - problem.lights[self.free[k]].position) @ frame.T
        cosine = local[:, 2] / np.maximum(np.linalg.norm(local, axis=1), 1e-9)
        lit = cosine > 0.02
        cosine, ahead = np.where(lit, cosine, 1.0), np.where(lit, local[:, 2], np.inf)
        turns = self.power * local[:, :2].T / ahead
        return lit * cosine**self.power, np.vstack([np.log(cosine), np.ones(len(lit)), turns])

    def moved(self, step: Array, start: _Lobes) -> _Lobes:
        """After a `step (1 + 3 n,)`; axes stay within `_MOST_ASIDE` of the hair."""
        each = step[1:].reshape(-1, 3)
        turned = np.array([x + d[1:] @ facing(x)[:2] for x, d in zip(self.axes, each, strict=True)])
        along = np.maximum((turned * start.axes).sum(axis=1, keepdims=True), 1e-6)
        aside = turned - along * start.axes
        far = np.linalg.norm(aside, axis=1, keepdims=True) / (along * _MOST_ASIDE)
        axes = along * start.axes + aside / np.maximum(far, 1)
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        power = float(np.clip(self.power + step[0], 0.0, MOST_POWER))
        return _Lobes(self.free, self.log_gain + each[:, 0], axes, power)


@dataclass(frozen=True, eq=False)
class _Images:
    """A light's N hits `points (N, 3)`, images `(N, 3)`, and two independent ones `rendered
    (2, N, 3)` without its lobe; `starts (B,)` of the `_PARTS` of its views."""

    points: Array
    rendered: Array
    captured: Array
    level: Array
    weight: Array
    starts: Ints


def _images(
    problem: FitProblem,
    raw: Raw,
    pairs: Sequence[Batch],
    lobes: _Lobes,
    effort: Effort,
    seed: int,
    shaped: bool,
) -> list[_Images]:
    """Of each light; rendered in its lobe and divided by that, if `shaped`."""
    count = len(problem.lights)
    if shaped:
        rows = as_calibrated(count)
        rows[lobes.free, :4] = np.column_stack([lobes.axes, np.full(len(lobes.free), lobes.power)])
        shown = problem.under(with_lobes(problem.lights, rows))
    else:
        shown = problem
    parts: list[list[tuple[Array, ...]]] = [[] for _ in lobes.free]
    for k, pair in enumerate(pairs):
        patch = Patch(pair.view, pair.lights, np.arange(len(problem.views[pair.view].pixels)))
        points = problem.points(patch)
        first = (seed << 12) + 2 * k
        halves = [
            shown.render(raw, np.ones(count), patch, effort, first + h, thrift=3.0) for h in (0, 1)
        ]
        rendered = np.array(halves)
        seen = problem.compare(patch, rendered.mean(axis=0))
        weight = np.where(seen.valid[..., None], (seen.level + FLOOR) ** -2, 0)
        # a rare bright path would outweigh all others in dark pixels
        weight = noise_weighted(weight, (rendered[0] - rendered[1]) ** 2, seen.level)
        for j, i in enumerate(patch.lights):
            if i in lobes.free:
                n = lobes.free.index(int(i))
                share = lobes.share(problem, n, points)[0] if shaped else np.ones(len(points))
                plain = rendered[:, j] / np.maximum(share, 1e-3)[:, None]
                parts[n].append((points, *plain, seen.captured[j], seen.level[j], weight[j]))
    out = []
    for views in parts:
        points, one, other, captured, level, weight = (
            np.concatenate(x) for x in zip(*views, strict=True)
        )
        sizes = np.concatenate([_part_sizes(len(view[0])) for view in views])
        starts = np.cumsum(sizes) - sizes
        both = np.array([one, other])
        out.append(_Images(points, both, captured, level, weight, starts))
    return out


def _part_sizes(pixels: int) -> Ints:
    """Of at most `_PARTS` parts that are not empty."""
    return np.array([len(x) for x in np.array_split(np.arange(pixels), _PARTS) if len(x)], int)


def _solve(
    problem: FitProblem, start: _Lobes, prior: _Lobes, wide: Array, images: list[_Images]
) -> tuple[_Lobes, Array]:
    """The lobes, and standard errors `(n, 2)` of axes and power; `wide` are those of `prior`."""
    lobes, colour, errors = start, np.zeros(3), wide
    squares = _squares(problem, lobes, colour, images)
    for _ in range(_STEPS):
        step, error = _step(problem, lobes, images, colour, prior, wide)
        if not np.isfinite(step).all():
            return prior, np.full((len(start.free), 2), np.inf)
        step, errors = np.clip(step, -_MOST_STEP, _MOST_STEP) * wide, error * wide
        for _ in range(_HALVINGS):
            moved = lobes.moved(step[3:], prior), colour + step[:3]
            if (after := _squares(problem, *moved, images)) <= 2 * max(squares, 0):
                (lobes, colour), squares = moved, after
                break
            step = 0.5 * step
        else:
            break
    axes = errors[4:].reshape(-1, 3)[:, 1:].max(axis=1)
    return lobes, np.column_stack([axes, np.full(len(axes), errors[3])])


def _squares(problem: FitProblem, lobes: _Lobes, colour: Array, images: list[_Images]) -> float:
    """The sum of squared errors, as products of the two renderings' errors, without noise."""
    total = 0.0
    for k, seen in enumerate(images):
        share = lobes.share(problem, k, seen.points)[0]
        off = seen.rendered * np.exp(lobes.log_gain[k] + colour) * share[:, None] - seen.captured
        total += float((off.prod(axis=0) * seen.weight).sum())
    return total


def _step(
    problem: FitProblem,
    lobes: _Lobes,
    images: list[_Images],
    colour: Array,
    prior: _Lobes,
    wide: Array,
) -> tuple[Array, Array]:
    """A step, and standard errors, both over `wide`: of colour, power, and the lights' numbers."""
    size = len(wide)
    matrix, spread = np.zeros((2, size, size))
    moment, about = np.zeros((2, size))
    about[3] = (lobes.power - prior.power) / wide[3]
    for k, seen in enumerate(images):
        own = np.r_[:4, 4 + 3 * k : 7 + 3 * k]
        share, logs = lobes.share(problem, k, seen.points)
        model = seen.rendered.mean(axis=0) * np.exp(lobes.log_gain[k] + colour) * share[:, None]
        by = np.zeros((7, *model.shape))
        by[[0, 1, 2], :, [0, 1, 2]] = 1.0
        by[3:] = logs[..., None]
        by *= wide[own, None, None]
        left = (by * seen.level * seen.weight).reshape(7, -1)
        residual = (model - seen.captured).ravel()
        matrix[np.ix_(own, own)] += left @ (by * model).reshape(7, -1).T
        moment[own] += left @ residual
        for error in (residual, _MODEL * seen.level.ravel()):
            parts = np.add.reduceat(left * error, 3 * seen.starts, axis=1)
            spread[np.ix_(own, own)] += parts @ parts.T
        turns = -facing(lobes.axes[k])[:2] @ prior.axes[k]
        about[own[4:]] = np.array([lobes.log_gain[k], *turns]) / wide[own[4:]]
    scale = np.maximum(np.sqrt(np.diag(spread)), np.finfo(float).tiny ** 0.5)
    spread = spread / np.outer(scale, scale) + 1e-6 * np.eye(size)
    half = np.linalg.solve(spread, np.column_stack([matrix, moment]) / scale[:, None])
    back = (matrix / scale[:, None]).T
    normal = back @ half[:, :-1] + np.diag(np.r_[np.full(3, 1e-6), np.ones(size - 3)])
    step = -np.linalg.solve(normal, back @ half[:, -1] + about)
    return step, np.sqrt(np.diag(np.linalg.inv(normal)))
