"""Roughness and colour of hair from OLAT frames (Sun et al. 2021, §5).

Roughness: pixel values near the mirror direction, binned over the deviation from it, are a lobe on
a floor of multiple scattering; the lobe's variance is the roughness (`fit_lobe`).
Two things bias that: hairs light each other near the mirror direction too, and other lobes lie
under the first. `match_roughness` measures renderings of known roughness in the same way and
reads the true value off them. Colour: Algorithm 1 with Eq. 11 and 12 (`fit_colour`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar, nnls
from scipy.stats import theilslopes

from appearance.bsdf.longitudinal import (
    absorption_of_colour,
    roughness_of_variance,
    variance_of_roughness,
)
from appearance.observations import Observed
from appearance.render.olat import render_olat
from appearance.render.tracing import Sampling
from appearance.scene.hair_appearance import DiffuseHair, HairAppearance
from appearance.scene.hair_scene import HairScene
from appearance.sun_fit.mirror_samples import LobeBins
from reconstruction.arrays import Array

LEAST_ROUGHNESS, GREATEST_ROUGHNESS = 0.02, 0.9
SAMPLING = Sampling(32, 16)
TOLERANCE = 0.01
"""Relative error of the mean colour at which Algorithm 1 ends."""


@dataclass(frozen=True)
class Lobe:
    """A lobe on a floor: `value = gain · M(v) + floor`; `residual` is relative to the values."""

    v: float
    gain: float
    floor: float
    residual: float

    @property
    def beta_m(self) -> float:
        """Chiang's roughness of the same variance."""
        return float(roughness_of_variance(self.v))


def fit_lobe(bins: LobeBins) -> Lobe:
    """The variance of the lobe in `bins`, by least squares over gain, floor ≥ 0 and v.

    Sun's Eq. 10 has no floor and reads twice the variance where multiple scattering adds a fifth of
    the peak. Gain and floor are solved for each v; v by a grid in log v and Brent's method.
    """
    # not the bins' own errors: a bin that missed its rare bright samples has a small error too
    weight = np.sqrt(bins.count / bins.count.mean())

    def solve(log_v: float) -> tuple[Array, float]:
        design = np.stack([bins.lobe(float(np.exp(log_v))), np.ones_like(bins.value)], axis=1)
        solution, residual = nnls(design * weight[:, None], bins.value * weight)
        return solution, residual

    log_v = _minimum(lambda x: solve(x)[1])
    (gain, floor), residual = solve(log_v)
    scale = float(np.linalg.norm(bins.value * weight))
    return Lobe(float(np.exp(log_v)), float(gain), float(floor), residual / scale)


def fit_lobe_as_printed(bins: LobeBins) -> float:
    """The variance by Sun's Eq. 10: the largest normalised correlation, without a floor."""

    def error(log_v: float) -> float:
        lobe = bins.lobe(float(np.exp(log_v)))
        return -float(bins.value @ lobe / np.linalg.norm(lobe))

    return float(np.exp(_minimum(error)))


def _minimum(error: Callable[[float], float]) -> float:
    """Where `error` of log v is least, over the roughness that hair can have."""
    ends = np.log(variance_of_roughness(np.array([LEAST_ROUGHNESS, GREATEST_ROUGHNESS])))
    grid = np.linspace(ends[0], ends[1], 49)
    best = int(np.argmin([error(float(x)) for x in grid]))
    low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    return float(minimize_scalar(error, bounds=(low, high), method="bounded").x)


def match_roughness(
    measured: float, rendered: Callable[[float], float], start: float
) -> tuple[float, list[tuple[float, float]]]:
    """The β_M whose renderings read `measured` when they are measured as the capture was.

    `measured` and `rendered(β_M)` are roughnesses by the same estimator, so that its bias cancels.
    Three renderings around `start` give a line in log β_M, a fourth where that says the answer is.
    Readings scatter by a few per cent and one may be far off: the line is Theil and Sen's, through
    medians, and the answer stays within a factor of 2 of `start`. Returns β_M and the pairs (β_M,
    rendered(β_M)).
    """
    pairs: list[tuple[float, float]] = []
    lowest, highest = (
        float(np.clip(start * factor, LEAST_ROUGHNESS, GREATEST_ROUGHNESS)) for factor in (0.5, 2.0)
    )
    for factor in (1.0, 0.75, 1.3):
        near = float(np.clip(start * factor, lowest, highest))
        pairs.append((near, rendered(near)))
    beta = start
    for last in (False, True):
        x, y = np.log(np.array(pairs)).T
        # an estimator that hardly answers to β_M must not throw the answer out of range
        gradient = float(np.clip(theilslopes(y, x)[0], 0.4, 1.5))
        wanted = (np.log(measured) - float(np.median(y - gradient * x))) / gradient
        beta = float(np.clip(np.exp(wanted), lowest, highest))
        if not last:
            pairs.append((beta, rendered(beta)))
    return beta, pairs


@dataclass(frozen=True, eq=False)
class FitPixels:
    """What the cameras observed: hair, and skin where they see some."""

    hair: Sequence[Observed]
    skin: Sequence[Observed] = ()


@dataclass(frozen=True)
class Colours:
    """What Algorithm 1 found: C, its hair and the skin's albedo.

    `first` is the C it started from; `errors` are the relative errors of the rendered mean colour
    of the hair, one a rendering.
    """

    colour: tuple[float, float, float]
    hair: HairAppearance
    skin: tuple[float, float, float]
    first: tuple[float, float, float]
    errors: list[float]


def fit_colour(
    scene: HairScene,
    pixels: FitPixels,
    *,
    start: Array | None = None,
    iterations: int = 5,
    sampling: Sampling = SAMPLING,
    on_iteration: Callable[[float], None] = lambda error: None,
) -> Colours:
    """Sun's Algorithm 1: the multiple-scattering albedo C whose rendering has the captured colour.

    The light is the mean of the single lights. `scene` gives geometry, roughness and first skin
    albedo, `start (3,)` the first C. An iteration renders the observed pixels, fits R = aC + b per
    channel (Eq. 12), takes Eq. 11's sigma of the next C, and tells `on_iteration` the error. The
    skin's albedo follows by the ratio of captured to rendered. Ends when the hair's mean colour is
    within `TOLERANCE`, or after `iterations` with one more update. Every rendering draws other
    random numbers, so that the fit averages their noise.
    """
    if not isinstance(scene.hair, HairAppearance):
        raise TypeError("fit_colour needs a scene with HairAppearance, not diffuse fibres")
    beta_n = scene.hair.beta_n
    target = _mean_colour(pixels.hair)
    skin_target = _mean_colour(pixels.skin) if pixels.skin else None
    colour = np.clip(_as_albedo(pixels.hair) if start is None else start, 0.02, 0.98)
    albedo = np.array(scene.skin)
    pairs: list[tuple[Array, Array]] = []
    errors: list[float] = []
    current = scene.hair
    for step in range(iterations):
        current = _with_colour(scene.hair, colour, beta_n)
        lit = scene.with_hair(current).with_skin(np.clip(albedo, 0, 1))
        now = replace(sampling, seed=sampling.seed + step)
        seen = _mean_colour([_rendered(lit, o, now) for o in pixels.hair])
        errors.append(float(np.linalg.norm(seen - target) / np.linalg.norm(target)))
        on_iteration(errors[-1])
        pairs.append((colour, seen))
        if skin_target is not None and step < 3:
            skin_seen = _mean_colour([_rendered(lit, o, now) for o in pixels.skin])
            albedo = np.clip(albedo * skin_target / np.maximum(skin_seen, 1e-12), 0.005, 0.98)
        if errors[-1] < TOLERANCE and step > 0:
            break
        colour = next_colour(pairs, target)
    best = _with_colour(scene.hair, colour, beta_n)
    return Colours(_rgb(colour), best, _rgb(albedo), _rgb(pairs[0][0]), errors)


def fit_diffuse(
    scene: HairScene, hair: Sequence[Observed], *, seed: int = 0
) -> tuple[float, float, float]:
    """The albedo of Lambertian fibres on the same strands that gives the captured mean colour.

    Algorithm 1 with the albedo in the place of C: the baseline that a hair BSDF has to beat.
    """
    target = _mean_colour(hair)
    albedo = np.clip(_as_albedo(hair), 0.02, 0.98)
    pairs: list[tuple[Array, Array]] = []
    for step in range(3):
        lit, now = scene.with_hair(DiffuseHair(_rgb(albedo))), replace(SAMPLING, seed=seed + step)
        pairs.append((albedo, _mean_colour([_rendered(lit, o, now) for o in hair])))
        albedo = next_colour(pairs, target)
    return _rgb(albedo)


def next_colour(pairs: Sequence[tuple[Array, Array]], target: Array) -> Array:
    """The next C of Algorithm 1 from the pairs (C, R) so far, each `(3,)`, and the captured R.

    The first step scales C by the ratio of captured to rendered; later ones solve Eq. 12's line,
    fitted to all pairs, for the captured R. Pairs weigh more the nearer the target they are, so
    that the line follows the curve's bend. A step stays within a factor of 2 of the nearest pair,
    and C in [0.005, 0.995].
    """
    c, r = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    out = np.empty(3)
    for k in range(3):
        off = np.abs(r[:, k] - target[k]) / max(target[k], 1e-12)
        nearest = int(np.argmin(off))
        value = c[nearest, k] * target[k] / max(r[nearest, k], 1e-12)
        if np.ptp(c[:, k]) > 1e-3 * c[nearest, k]:
            weight = 1.0 / (off + 0.02)
            middle, level = np.average(c[:, k], weights=weight), np.average(r[:, k], weights=weight)
            spread = np.sum(weight * (c[:, k] - middle) ** 2)
            gradient = np.sum(weight * (c[:, k] - middle) * (r[:, k] - level)) / spread
            if gradient > 0:  # noise may turn it between two colours that are all but equal
                value = middle + (target[k] - level) / gradient
        out[k] = np.clip(value, 0.5 * c[nearest, k], 2.0 * c[nearest, k])
    return np.clip(out, 0.005, 0.995)


def _with_colour(hair: HairAppearance, colour: Array, beta_n: float) -> HairAppearance:
    return replace(hair, sigma_a=_rgb(absorption_of_colour(colour, beta_n)))


def _rgb(values: Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def _rendered(scene: HairScene, o: Observed, sampling: Sampling) -> Observed:
    """The same pixels under the same lights, rendered; lights sampled, as only means are used."""
    spent = {**asdict(sampling), "first_lights": 8, "deep_lights": 4, "thrift": 0}
    return replace(o, radiance=render_olat(scene, o.camera, o.lights, pixels=o.pixels, **spent))


def _mean_colour(views: Sequence[Observed]) -> Array:
    """Mean radiance `(3,)` over the valid samples of all views: the hair under uniform light."""
    total = sum(np.where(o.valid[..., None], o.radiance, 0).sum((0, 1), dtype=float) for o in views)
    return np.asarray(total / max(sum(int(o.valid.sum()) for o in views), 1))


def _as_albedo(views: Sequence[Observed]) -> Array:
    """Mean radiance over that of a white Lambertian surface: Algorithm 1's first guess of C."""
    irradiance = np.zeros(3)
    for o in views:
        for light in o.lights:
            # half of the lights of a dome lie behind any surface, and those in front at 60 degrees
            intensity = light.intensity_towards(np.zeros(3))
            irradiance += intensity / (4 * np.pi * (light.position @ light.position))
    lights = sum(len(o.lights) for o in views)
    return _mean_colour(views) / np.maximum(irradiance / lights, 1e-12)
