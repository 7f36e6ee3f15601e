"""BSDF samples near the mirror direction of hair fibres (Sun et al. 2021, Eq. 9)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from appearance.bsdf.longitudinal import longitudinal
from appearance.observations import Observed
from appearance.sun_fit.visible_fibres import VisibleFibres
from reconstruction.arrays import Array, Bools, Ints

WINDOW = np.pi / 6
"""Sun Eq. 9: largest deviation of samples from the mirror direction."""
BINS = 32
LEAST_SHARE, MOST_SPREAD = 0.9, 0.06
LEAST_LIT = 0.1
"""Least share of a light's largest intensity in a pixel; below it indirect light dominates."""
_PAIRS = 96  # directions kept a bin, each with all its pixel's fibres, to average the model over


@dataclass(frozen=True, eq=False)
class MirrorSamples:
    """Hair pixels under lights near their mirror direction, `n` samples in `K` rays a pixel.

    `deviation (n,)` is θ_i + θ_o + 2 tilt, signed, at the pixel's mean tangent; `value (n,)` is
    radiance over the light's irradiance across the ray, 1/sr. `theta_i`, `theta_o (n, K)` are the
    inclinations at each ray's fibre, the tilt already added to `theta_o`; `hair (n, K)` marks the
    rays that met one.
    """

    deviation: Array
    value: Array
    theta_i: Array
    theta_o: Array
    hair: Bools

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """The samples of several views as one."""
        names = [f.name for f in fields(cls)]
        return cls(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


@dataclass(frozen=True, eq=False)
class LobeBins:
    """Mean BSDF values over the deviation from the mirror direction; empty bins are not kept.

    `deviation`, `value (B,)` and its standard error `error (B,)`; `count (B,)` samples. `theta_i`,
    `theta_o (B, S, K)` are the inclinations of S of them; `weight (B, S, K)` sums to 1 a bin.
    """

    deviation: Array
    value: Array
    error: Array
    count: Ints
    theta_i: Array
    theta_o: Array
    weight: Array

    def lobe(self, v: float) -> Array:
        """Sun's Eq. 8 with variance `v` in each bin `(B,)`, over the tangents that pixels mix."""
        return np.asarray((longitudinal(self.theta_i, self.theta_o, v) * self.weight).sum((1, 2)))


def mirror_samples(
    observed: Observed,
    fibres: VisibleFibres,
    *,
    tilt_deg: float,
    channel: int,
) -> MirrorSamples:
    """Samples of one view with |θ_i + θ_o + 2 tilt| and |φ_i − φ_o| below π/6 (Eq. 9).

    `channel` should be the darkest, with the least light from inside the fibres. Pixels that are
    not `usable` are left out.
    """
    found = near_mirror(observed, fibres, tilt_deg)
    light, pixel = np.nonzero(found.near)
    tangent = fibres.tangent[pixel].astype(float)
    intensity = found.shines[light, pixel, channel]
    value = observed.radiance[light, pixel, channel] * found.squared[light, pixel] / intensity
    to_camera = _unit(observed.camera.center - found.middle)
    theta_o = _angle(np.einsum("pi,pki->pk", to_camera, fibres.tangent)) + 2 * np.radians(tilt_deg)
    return MirrorSamples(
        found.deviation[light, pixel],
        value / fibres.share[pixel],
        _angle(np.einsum("ni,nki->nk", found.towards[light, pixel], tangent)),
        theta_o[pixel],
        fibres.hair[pixel],
    )


def mirror_lights(
    observed: Observed, fibres: VisibleFibres, *, tilt_deg: float, window: float = WINDOW
) -> Ints:
    """Indices `(K,)` of the lights near the mirror direction of a share of 3 % of the pixels."""
    near = near_mirror(observed, fibres, tilt_deg, window).near
    return np.flatnonzero(near.sum(axis=1) > 0.03 * near.shape[1])


def binned(samples: MirrorSamples, *, seed: int = 0) -> LobeBins:
    """Average the samples in 32 bins of |deviation| up to π/6 (Sun §5.1).

    Raises `ValueError` for fewer than 100 samples or 8 bins.
    """
    inside = np.abs(samples.deviation) < WINDOW
    bin_of = np.where(inside, (np.abs(samples.deviation) / WINDOW * BINS).astype(int), BINS)
    counts = np.bincount(bin_of, minlength=BINS + 1)[:BINS]
    keep = np.flatnonzero(counts >= 5)
    if counts.sum() < 100 or len(keep) < 8:
        raise ValueError(
            f"only {counts.sum()} samples in {len(keep)} of {BINS} bins lie near the mirror "
            "direction: the roughness needs more lights, more hair pixels of one direction, or "
            "strands of this capture"
        )
    rng = np.random.default_rng(seed)
    by_bin = np.split(np.argsort(bin_of, kind="stable"), np.cumsum(counts))
    members = [by_bin[b] for b in keep]
    take = np.array([rng.choice(m, _PAIRS) for m in members])
    weight = samples.hair[take].astype(float)
    return LobeBins(
        deviation=np.array([np.abs(samples.deviation[m]).mean() for m in members]),
        value=np.array([samples.value[m].mean() for m in members]),
        error=np.array([samples.value[m].std() / np.sqrt(len(m)) for m in members]),
        count=counts[keep],
        theta_i=samples.theta_i[take],
        theta_o=samples.theta_o[take],
        weight=weight / weight.sum(axis=(1, 2), keepdims=True),
    )


@dataclass(frozen=True, eq=False)
class NearMirror:
    """Which lights are near the mirror direction of which pixels, `near (L, P)`.

    `deviation (L, P)` is θ_i + θ_o + 2 tilt at the pixel's mean tangent; `middle (P, 3)` the mean
    of its rays' hits, `towards (L, P, 3)` and `squared (L, P)` the unit direction and squared
    distance from there to the light, `shines (L, P, 3)` the light's intensity, W/sr.
    """

    near: Bools
    deviation: Array
    middle: Array
    towards: Array
    squared: Array
    shines: Array


def usable(fibres: VisibleFibres) -> Bools:
    """Pixels `(P,)` with enough hair, of one direction: `LEAST_SHARE` and `MOST_SPREAD`, rad²."""
    return np.asarray((fibres.share >= LEAST_SHARE) & (fibres.spread() <= MOST_SPREAD))


def near_mirror(
    observed: Observed,
    fibres: VisibleFibres,
    tilt_deg: float,
    window: float = WINDOW,
) -> NearMirror:
    """Samples with |θ_i + θ_o + 2 tilt| below `window` and |φ_i − φ_o| below π/6.

    Fibres are along each pixel's mean tangent. Pixels that are not `usable` are left out, and
    lights below `LEAST_LIT` of their largest intensity.
    """
    middle = _middle(fibres)
    mean = fibres.mean_tangent()
    to_camera = _unit(observed.camera.center - middle)
    towards = _positions(observed)[:, None] - middle
    squared = (towards**2).sum(axis=-1)
    towards /= np.sqrt(squared)[..., None]
    sin_o, sin_i = (to_camera * mean).sum(-1), (towards * mean).sum(-1)
    across_o = _unit(to_camera - sin_o[:, None] * mean)
    across_i = _unit(towards - sin_i[..., None] * mean)
    deviation = _angle(sin_i) + _angle(sin_o) + 2 * np.radians(tilt_deg)
    near = (np.abs(deviation) < window) & observed.valid
    near &= (across_i * across_o).sum(-1) > np.cos(WINDOW)
    near &= usable(fibres)
    shines = np.array([light.intensity_towards(middle) for light in observed.single_lights])
    shines = shines.reshape(*near.shape, 3)
    least = LEAST_LIT * shines.max(axis=1, keepdims=True, initial=0)
    near &= ((shines > 0) & (shines >= least)).all(axis=-1)
    return NearMirror(near, deviation, middle, towards, squared, shines)


def _positions(observed: Observed) -> Array:
    return np.array([light.position for light in observed.lights]).reshape(-1, 3)


def _middle(fibres: VisibleFibres) -> Array:
    """Mean of a pixel's hits `(P, 3)`."""
    count = np.maximum(fibres.hair.sum(axis=1), 1)
    return np.asarray(fibres.point.sum(axis=1, dtype=float) / count[:, None])


def _angle(sine: Array) -> Array:
    return np.arcsin(np.clip(sine, -1.0, 1.0))


def _unit(a: Array) -> Array:
    return np.asarray(a / np.maximum(np.linalg.norm(a, axis=-1, keepdims=True), 1e-12))
