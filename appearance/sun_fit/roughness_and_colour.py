"""Roughness and colour of hair from OLAT frames (Sun et al. 2021, §5).

Roughness: pixel values near the mirror direction, binned over the deviation from it, are a lobe on
a floor of multiple scattering; the lobe's variance gives the roughness (`fit_lobe`). It is biased
by multiple scattering, by other lobes and by errors of tangents: the result of a fit is that of
`light_correlation`. Colour: Algorithm 1 with Eq. 11 and 12 (`fit_colour`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar, nnls

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
from appearance.sun_fit.fit_pixels import FitPixels, cosines_of_lights
from appearance.sun_fit.hair_parts import SIDE, parts_of
from appearance.sun_fit.mirror_samples import LobeBins
from appearance.sun_fit.options import FitOptions
from reconstruction.arrays import Array

LEAST_ROUGHNESS, GREATEST_ROUGHNESS = 0.02, 0.9
LEAST_ALBEDO, MOST_ALBEDO = 0.005, 0.995
LEAST_SKIN, MOST_SKIN = 0.005, 0.98
SAMPLING = Sampling(32, 16)
TOLERANCE = 0.01
"""Relative error of the mean colour at which Algorithm 1 ends."""
MORE = 2.0
"""Factor on the absorption of the two renderings for the derivative."""


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
    # not the bins' own errors: a bin without rare bright samples has too small an error
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
    """The log v of least `error`, over the roughness of hair."""
    ends = np.log(variance_of_roughness(np.array([LEAST_ROUGHNESS, GREATEST_ROUGHNESS])))
    grid = np.linspace(ends[0], ends[1], 49)
    best = int(np.argmin([error(float(x)) for x in grid]))
    low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    return float(minimize_scalar(error, bounds=(low, high), method="bounded").x)


@dataclass(frozen=True)
class Colours:
    """The result of Algorithm 1: C, its hair and the skin's albedo.

    `pairs` are the rendered C `(3,)` with the hair's mean colours; `errors` their relative errors.
    """

    colour: tuple[float, float, float]
    hair: HairAppearance
    skin: tuple[float, float, float]
    pairs: list[tuple[Array, Array]]
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
    albedo, `start (3,)` the first C. An iteration renders the observed pixels with own random
    numbers, fits R = aC + b per channel (Eq. 12), takes Eq. 11's sigma of the next C, and passes
    its error to `on_iteration`. The skin's albedo is scaled by the ratio of captured to rendered.
    Ends when the hair's mean colour is within `TOLERANCE`, or after `iterations`.
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
        views = [_rendered(lit, o, now) for o in pixels.hair]
        rendered = _mean_colour(views)
        errors.append(_off(rendered, target))
        on_iteration(errors[-1])
        pairs.append((colour, rendered))
        if skin_target is not None and step < 3:
            skin = _mean_colour([_rendered(lit, o, now) for o in pixels.skin])
            albedo = np.clip(albedo * skin_target / np.maximum(skin, 1e-12), LEAST_SKIN, MOST_SKIN)
        if errors[-1] < TOLERANCE and step > 0:
            break
        colour = next_colour(pairs, target)
    best = _with_colour(scene.hair, colour, beta_n)
    return Colours(_rgb(colour), best, _rgb(albedo), pairs, errors)


def absorption_error(
    scene: HairScene,
    hair: Sequence[Observed],
    colours: Colours,
    sampling: Sampling = SAMPLING,
    least_paths: int = FitOptions.error_paths,
) -> Array:
    """Standard error of log sigma_a `(3,)`, over pixels under lights from all around.

    The scatter of captured over rendered colour between parts of the hair, views and directions of
    light, divided by the derivative of the mean colour by log sigma_a. Infinite in a channel
    without a derivative, as of black hair, and at an end of C's range.
    """
    paths = sampling.spp * sum(len(o.pixels) for o in hair)
    sampling = replace(sampling, spp=sampling.spp * max(1, least_paths // max(paths, 1)))
    as_dark = (1 / MORE, 1.0, MORE)
    each = [
        replace(colours.hair, sigma_a=_rgb(x * np.array(colours.hair.sigma_a))) for x in as_dark
    ]
    less, lit, more = (
        [_rendered(scene.with_hair(x).with_skin(colours.skin), o, sampling) for o in hair]
        for x in each
    )
    bright, dark = (np.maximum(_mean_colour(views), 1e-12) for views in (less, more))
    gradient = np.log(bright / dark) / (2 * np.log(MORE))
    colour = np.array(colours.colour)
    known = (gradient > 0) & (colour > LEAST_ALBEDO) & (colour < MOST_ALBEDO)
    scatter = np.maximum(_scatter(hair, lit), _disagreement(scene, hair, lit))
    return np.where(known, scatter / np.where(known, gradient, 1.0), np.inf)


def fit_diffuse(
    scene: HairScene, hair: Sequence[Observed], *, seed: int = 0
) -> tuple[float, float, float]:
    """The albedo of Lambertian fibres that gives the captured mean colour, by Algorithm 1: a
    baseline."""
    target = _mean_colour(hair)
    albedo = np.clip(_as_albedo(hair), 0.02, 0.98)
    pairs: list[tuple[Array, Array]] = []
    for step in range(5):
        lit, now = scene.with_hair(DiffuseHair(_rgb(albedo))), replace(SAMPLING, seed=seed + step)
        pairs.append((albedo, _mean_colour([_rendered(lit, o, now) for o in hair])))
        if _off(pairs[-1][1], target) < TOLERANCE:
            break
        albedo = next_colour(pairs, target)
    return _rgb(albedo)


def next_colour(pairs: Sequence[tuple[Array, Array]], target: Array) -> Array:
    """The next C of Algorithm 1 from the pairs (C, R) so far, each `(3,)`, and the captured R.

    The first step scales C by the ratio of captured to rendered; later ones solve Eq. 12's line,
    fitted to all pairs with more weight near the target, for the captured R. A step stays within a
    factor of 2 of the nearest pair, and C in [`LEAST_ALBEDO`, `MOST_ALBEDO`].
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
    return np.clip(out, LEAST_ALBEDO, MOST_ALBEDO)


def _off(colour: Array, target: Array) -> float:
    return float(np.linalg.norm(colour - target) / np.linalg.norm(target))


def _with_colour(hair: HairAppearance, colour: Array, beta_n: float) -> HairAppearance:
    return replace(hair, sigma_a=_rgb(absorption_of_colour(colour, beta_n)))


def _rgb(values: Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def _rendered(scene: HairScene, o: Observed, sampling: Sampling) -> Observed:
    """The same pixels under the same lights, rendered; lights sampled, as only means are used."""
    options = {**asdict(sampling), "first_lights": 8, "deep_lights": 4, "thrift": 0}
    return replace(o, radiance=render_olat(scene, o.camera, o.lights, pixels=o.pixels, **options))


def _mean_colour(views: Sequence[Observed]) -> Array:
    """Mean radiance `(3,)` over the valid samples of all views: the hair under uniform light."""
    total = sum(np.where(o.valid[..., None], o.radiance, 0).sum((0, 1), dtype=float) for o in views)
    return np.asarray(total / max(sum(int(o.valid.sum()) for o in views), 1))


def _scatter(captured: Sequence[Observed], rendered: Sequence[Observed]) -> Array:
    """Standard error `(3,)` of the log ratio of mean colours: jackknife over parts, or views."""
    one, other = (np.stack([_sums(o) for o in views]) for views in (captured, rendered))
    flat = [x.reshape(-1, 3) for x in (one, other)]
    left = [np.maximum(x.sum(0) - x, 1e-12) for x in flat]
    ratio = np.log(left[0] / left[1])
    scatter = np.sqrt((len(ratio) - 1) * ratio.var(axis=0))
    if len(one) > 1:
        views = np.log(np.maximum(one.sum(1), 1e-12) / np.maximum(other.sum(1), 1e-12))
        scatter = np.maximum(scatter, views.std(axis=0, ddof=1) / np.sqrt(len(views)))
    return np.asarray(scatter)


def _disagreement(
    scene: HairScene, captured: Sequence[Observed], rendered: Sequence[Observed]
) -> Array:
    """Standard error `(3,)` of the log ratio of mean colours between thirds of the lights."""
    sides = [np.digitize(cosines_of_lights(scene, o), (-1 / 3, 1 / 3)) for o in captured]
    ratios = []
    for side in range(3):
        one, other = (
            _mean_colour(
                [o.under(np.flatnonzero(s == side)) for o, s in zip(x, sides, strict=True)]
            )
            for x in (captured, rendered)
        )
        if one.any() and other.any():
            ratios.append(np.log(np.maximum(one, 1e-12) / np.maximum(other, 1e-12)))
    if len(ratios) < 2:
        return np.zeros(3)
    return np.asarray(np.std(ratios, axis=0, ddof=1) / np.sqrt(len(ratios)))


def _sums(o: Observed) -> Array:
    """Radiance summed over each part of a view's hair `(9, 3)`."""
    of_pixel = np.where(o.valid[..., None], o.radiance, 0).sum(axis=0, dtype=float)
    part = parts_of(o)
    return np.stack([of_pixel[part == k].sum(axis=0) for k in range(SIDE**2)])


def _as_albedo(views: Sequence[Observed]) -> Array:
    """Mean radiance over that of a white Lambertian surface: Algorithm 1's first guess of C."""
    irradiance = np.zeros(3)
    for o in views:
        for light in o.lights:
            # half of the lights of a dome lie behind any surface, and those in front at 60 degrees
            irradiance += light.irradiance(np.zeros(3)) / (4 * np.pi)
    lights = sum(len(o.lights) for o in views)
    return _mean_colour(views) / np.maximum(irradiance / lights, 1e-12)
