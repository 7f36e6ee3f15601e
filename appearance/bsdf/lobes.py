"""The hair BSDF in Dr.Jit: R, TT, TRT and the residual lobe, near field, in stable forms.

Symbols and conventions are those of `appearance.bsdf.reference`. Every function takes Python
floats, float32 or float64 Dr.Jit arrays of any back end, and is differentiable in all arguments.

Forms without the cancellation of the printed ones:
- cos(theta) is the length of the direction's part across the fibre, not sqrt(1 - sin²): float32
  directions resolve the narrowest lobe up to the fibre's axis;
- M's exponent (c - s - 1)/v is -|chord|²/(2v), the chord from the mirror direction;
- with q = eta² - 1, refraction is written with square roots of sums: q + mu² instead of
  eta² - sin², which stays exact at grazing angles, |h| = 1 and indices close to 1;
- 1 - F and 1 - F T are formed without subtracting from 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import pi, sqrt
from typing import Any

import drjit as dr

from appearance.bsdf.bessel import scaled_i0

LOBES = 4
LEAST_CHOICE = 1e-9
"""Lobes whose probability is together below this are never sampled: no density underflows."""
PARTS, OFFSETS = 4, 4
"""Parts of a fibre's width that `mean_over_width` averages over, and points of each."""
_TINY = 1e-18
"""Its square is a normal float32."""
_LEAST_UNIFORM = 2.0**-25
"""Stands for the uniform number 0, which is any number below 2^-24."""


@dataclass(frozen=True)
class Fibre:
    """Parameters of hair fibres, of which any may be one number or one per lane.

    `sigma_a` is the absorption per fibre radius, three channels (or one number); `beta_m`,
    `beta_n` in [0.001, 1]; `eta` >= 1.0001 the fibre's index relative to what surrounds it; `tilt`
    the cuticle's tilt in radians, positive where R moves towards the root.
    """

    sigma_a: Any
    beta_m: Any
    beta_n: Any
    eta: Any = 1.55
    tilt: Any = 0.0


@dataclass(frozen=True)
class Known:
    """Quantities of a fibre and the known direction `wi`, for all lobes.

    `sine`, `cosine` of the tilted inclination, `m` (`Longitudinal`) and `attenuation` A_p are one
    per lobe; `choice` the probabilities of sampling each, summing to 1; `n` (`Azimuthal`) is that
    of all lobes; `turn` is gamma_o + gamma_i in the middle of R, TT and TRT; `direction` makes a
    vector of the type of `wi`.
    """

    gamma: Any
    sine: Sequence[Any]
    cosine: Sequence[Any]
    m: Sequence[Longitudinal]
    n: Azimuthal
    turn: Sequence[Any]
    attenuation: Sequence[Any]
    choice: Sequence[Any]
    direction: Callable[[Any, Any, Any], Any]


def variances(beta_m: Any) -> tuple[Any, ...]:
    """v of the four lobes."""
    v = (0.726 * beta_m + 0.812 * beta_m**2 + 3.7 * beta_m**20) ** 2
    return v, 0.25 * v, 4 * v, 4 * v


def logistic_scale(beta_n: Any) -> Any:
    """s, the scale of the azimuthal logistic."""
    return sqrt(pi / 8) * (0.265 * beta_n + 1.194 * beta_n**2 + 5.372 * beta_n**22)


def across(w: Any) -> tuple[Any, Any, Any]:
    """cos(theta) of the direction `w`, and its unit part (x, z) across the fibre.

    Along the fibre itself, where there is no azimuth, the part is (0, 0).
    """
    cosine = dr.sqrt(w.x * w.x + w.z * w.z + _TINY * _TINY)
    return cosine, w.x / cosine, w.z / cosine


def azimuth(w: Any) -> Any:
    """gamma of the direction `w`; 0 along the fibre."""
    z = dr.select((w.x == 0) & (w.z == 0), 1, w.z)
    return dr.atan2(-w.x, z)


def tilted(sine: Any, cosine: Any, tilt: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Sines and cosines of each lobe's tilted inclination, folded into [-pi/2, pi/2]."""
    s1, c1 = dr.sin(tilt), dr.cos(tilt)
    s2, c2 = 2 * s1 * c1, c1 * c1 - s1 * s1
    s4, c4 = 2 * s2 * c2, c2 * c2 - s2 * s2
    turns = ((s2, c2), (-s1, c1), (-s4, c4))
    sines = (*(sine * c + cosine * s for s, c in turns), sine)
    return sines, (*(dr.abs(cosine * c - sine * s) for s, c in turns), cosine)


def one_minus_exp(x: Any) -> Any:
    """1 - exp(-x) for x >= 0, without cancellation."""
    return dr.tanh(0.5 * x) * (1 + dr.exp(-x))


@dataclass(frozen=True)
class Longitudinal:
    """M_p of the variance `v`; made once for many directions."""

    v: Any
    rate: Any
    scale: Any

    @classmethod
    def of(cls, v: Any) -> Longitudinal:
        """M_p of `v`."""
        r = dr.rcp(v)
        return cls(v, r, r / one_minus_exp(2 * r))

    def at(self, sine_i: Any, cosine_i: Any, sine_o: Any, cosine_o: Any) -> Any:
        """M_p, from sines and cosines of the inclinations."""
        chord = (cosine_i - cosine_o) ** 2 + (sine_i + sine_o) ** 2
        r = self.rate
        return scaled_i0(cosine_i * cosine_o * r) * dr.exp(-0.5 * chord * r) * self.scale


@dataclass(frozen=True)
class Azimuthal:
    """N_p of R, TT and TRT for the scale `s` of the logistic; made once for many directions."""

    s: Any
    rate: Any
    scale: Any

    @classmethod
    def of(cls, s: Any) -> Azimuthal:
        """N_p of `s`."""
        return cls(s, dr.rcp(s), dr.rcp(s * dr.tanh(0.5 * pi / s)))

    def at(self, x: Any) -> Any:
        """N_p at the azimuth `x` from the lobe's middle, of any period."""
        x = x - 2 * pi * dr.round(x * (0.5 / pi))
        z = dr.exp(-dr.abs(x) * self.rate)
        return z * self.scale / (1 + z) ** 2


def fresnel(mu: Any, eta: Any) -> tuple[Any, Any]:
    """F and 1 - F at the cosine `mu` >= 0 to the surface's normal, `eta` > 1."""
    q = (eta - 1) * (eta + 1)
    w = dr.sqrt(q + mu * mu)
    n = eta * eta
    s, p = mu + w, n * mu + w
    reflected_s = (q / (s * s)) ** 2
    reflected_p = (q * ((n + 1) * mu * mu - 1) / (p * p)) ** 2
    through = 2 * mu * w * (1 / (s * s) + n / (p * p))
    return 0.5 * (reflected_s + reflected_p), through


def refraction(cosine: Any, sin_gamma: Any, cos_gamma: Any, eta: Any) -> tuple[Any, Any]:
    """gamma_t inside the fibre, and the length of one crossing in fibre radii."""
    q = (eta - 1) * (eta + 1)
    deep = dr.sqrt(q + (cosine * cos_gamma) ** 2)
    gamma_t = dr.atan2(sin_gamma * cosine, deep)
    return gamma_t, 2 * eta * deep / (q + cosine * cosine)


def attenuations(f: Any, through: Any, depth: Any) -> tuple[Any, ...]:
    """A_p of the four lobes from F, 1 - F and the optical `depth` sigma_a times length."""
    t = dr.exp(-depth)
    tt = through * through * t
    trt = tt * f * t
    rest = dr.maximum(through + f * one_minus_exp(depth), _TINY)
    return f, tt, trt, through * (through / rest) * t * (f * t) ** 2


def known(fibre: Fibre, wi: Any) -> Known:
    """Everything that does not depend on the direction to evaluate."""
    cosine, x, z = across(wi)
    gamma = azimuth(wi)
    sines, cosines = tilted(wi.y, cosine, fibre.tilt)
    gamma_t, length = refraction(cosine, -x, z, fibre.eta)
    f, through = fresnel(dr.abs(wi.z), fibre.eta)
    attenuation = attenuations(f, through, fibre.sigma_a * length)
    # dr.mean would put the number of lanes into the kernel: one to compile for each number
    mean = [dr.sum(a, axis=0) / 3 if dr.depth_v(a) > dr.depth_v(gamma) else a for a in attenuation]
    total = dr.rcp(mean[0] + mean[1] + mean[2] + mean[3])
    return Known(
        gamma,
        sines,
        cosines,
        [Longitudinal.of(v) for v in variances(fibre.beta_m)],
        Azimuthal.of(logistic_scale(fibre.beta_n)),
        (0.0, 2 * gamma_t + pi, 4 * gamma_t),
        attenuation,
        [m * total for m in mean],
        type(wi),
    )


def lobe(k: Known, p: int, wo: Any) -> Any:
    """M_p N_p: the density by solid angle of lobe `p` towards `wo`."""
    cosine, _, _ = across(wo)
    return _lobe(k, p, wo.y, cosine, azimuth(wo))


def _lobe(k: Known, p: int, sine: Any, cosine: Any, gamma: Any) -> Any:
    m = k.m[p].at(k.sine[p], k.cosine[p], sine, cosine)
    if p == LOBES - 1:
        return m * (0.5 / pi)
    return m * k.n.at(gamma + k.gamma - k.turn[p])


def value_known(k: Known, wo: Any) -> Any:
    """BSDF times cosine towards `wo`; per steradian."""
    cosine, _, _ = across(wo)
    gamma = azimuth(wo)
    value: Any = 0.0
    for p in range(LOBES):
        value = value + k.attenuation[p] * _lobe(k, p, wo.y, cosine, gamma)
    return value


def mean_over_width(fibre: Fibre, wi: Any) -> Callable[[Any], Any]:
    """`evaluate`'s value, averaged over the part of the width where `wi` leaves, for any `wo`.

    For fibres thinner than a pixel, with less noise than a value at one offset h: the mean of
    `OFFSETS` values at equal distances in one of `PARTS` equal parts, that of `wi` among them. The
    visible and the lit part of a fibre are not independent: direct light on the demo's hair is 0.3
    to 0.6 % too bright (halves: 1.8 %, eighths: 0.1 %), and up to 1.8 % from the side.
    """
    k = known(fibre, wi)
    cosine, x, _ = across(wi)
    place = dr.clip(0.5 * PARTS * (1 - x), 0, PARTS * (1 - 1e-6))
    part = dr.floor(place)
    attenuation, turns = [], []
    for j in range(OFFSETS):
        within = place - part + j / OFFSETS
        h = 2 / PARTS * (part + within - dr.floor(within)) - 1
        cos_gamma, gamma = dr.sqrt((1 - h) * (1 + h)), dr.asin(h)
        gamma_t, length = refraction(cosine, h, cos_gamma, fibre.eta)
        f, through = fresnel(cosine * cos_gamma, fibre.eta)
        attenuation.append(attenuations(f, through, fibre.sigma_a * length))
        middle = k.gamma - 2 * gamma
        turns.append((middle, middle + 2 * gamma_t + pi, middle + 4 * gamma_t))

    def value(wo: Any) -> Any:
        cosine, _, _ = across(wo)
        gamma = azimuth(wo)
        total: Any = 0.0
        for p in range(LOBES):
            around: Any = 0.0
            for a, turn in zip(attenuation, turns, strict=True):
                around += a[p] * (k.n.at(gamma - turn[p]) if p < LOBES - 1 else 0.5 / pi)
            total += around * k.m[p].at(k.sine[p], k.cosine[p], wo.y, cosine)
        return total / OFFSETS

    return value


def evaluate_known(k: Known, wo: Any) -> tuple[Any, Any]:
    """BSDF times cosine, and the density of `sample_known`, towards `wo`; per steradian."""
    cosine, _, _ = across(wo)
    gamma = azimuth(wo)
    value: Any = 0.0
    pdf: Any = 0.0
    for p in range(LOBES):
        density = _lobe(k, p, wo.y, cosine, gamma)
        value = value + k.attenuation[p] * density
        pdf = pdf + k.choice[p] * density
    return value, pdf


def evaluate(fibre: Fibre, wi: Any, wo: Any) -> tuple[Any, Any]:
    """BSDF times cosine, and the density of `sample`, towards `wo`; per steradian.

    Value over density is at most 3, whatever the parameters: lobes are chosen by the mean of the
    three channels of their share.
    """
    return evaluate_known(known(fibre, wi), wo)


def sample(fibre: Fibre, wi: Any, u1: Any, u2: Any, u3: Any) -> tuple[Any, Any, Any]:
    """A direction `wo`, its density and its weight (value over density).

    `u1`, `u2`, `u3` in [0, 1) are independent uniform numbers; `u1` chooses the lobe and then the
    azimuth within it.
    """
    k = known(fibre, wi)
    past, u = choose(k.choice, u1)
    m = (pick(past, k.sine), pick(past, k.cosine), pick(past, [m.v for m in k.m]))
    wo = _draw(k, m, pick(past, (*k.turn, 0.0)), past[-1], (u, u2, u3))
    value, pdf = evaluate_known(k, wo)
    return wo, pdf, value / pdf


def sample_lobe(k: Known, p: int, u1: Any, u2: Any, u3: Any) -> Any:
    """A direction of lobe `p` alone, of density `lobe`."""
    last = p == LOBES - 1
    turn = 0.0 if last else k.turn[p]
    return _draw(k, (k.sine[p], k.cosine[p], k.m[p].v), turn, last, (u1, u2, u3))


def choose(choice: Sequence[Any], u: Any) -> tuple[list[Any], Any]:
    """Which lobe `u` in [0, 1) falls on, and `u` rescaled to [0, 1] within it.

    The lobe is given as three masks: past R, past TT, past TRT.
    """
    past, left = [], [choice[3]]
    for share in choice[2:0:-1]:
        left.insert(0, left[0] + share)
    low: Any = 0.0
    width: Any = choice[0]
    below: Any = choice[0]
    for p in range(1, LOBES):
        beyond = (u >= below) & (left[p - 1] > LEAST_CHOICE)
        past.append(beyond)
        low, width = dr.select(beyond, below, low), dr.select(beyond, choice[p], width)
        below = below + choice[p]
    return past, (u - low) / width


def pick(past: Sequence[Any], values: Sequence[Any]) -> Any:
    """The one of four `values` that `choose` chose."""
    picked = values[0]
    for beyond, value in zip(past, values[1:], strict=True):
        picked = dr.select(beyond, value, picked)
    return picked


def logistic_sample(u: Any, s: Any) -> Any:
    """Azimuth from a lobe's middle, in [-pi, pi], with the density `n_p`."""
    u = dr.clip(u, _LEAST_UNIFORM, 1 - 2 * _LEAST_UNIFORM)
    tail = dr.exp(-pi / s)
    tail = tail / (1 + tail)
    x = s * dr.log((tail + u * (1 - 2 * tail)) / (tail + (1 - u) * (1 - 2 * tail)))
    return dr.clip(x, -pi, pi)


def fisher_sample(v: Any, u: Any) -> tuple[Any, Any]:
    """1 - cos and sin of the angle to the mean direction, that gives M_p its density.

    d'Eon 2013: cos = 1 + v log(u + (1 - u) exp(-2/v)). Formed as it stands, the narrow lobes fall
    on the few float32 numbers below 1.
    """
    u = dr.maximum(u, _LEAST_UNIFORM)
    below = dr.clip(-v * dr.log(u + (1 - u) * dr.exp(-2 / v)), 0, 2)
    return below, dr.sqrt(below * (2 - below))


def _draw(k: Known, m: tuple[Any, Any, Any], turn: Any, last: Any, u: tuple[Any, Any, Any]) -> Any:
    sine, cosine, v = m
    below, spread = fisher_sample(v, u[1])
    s3, c3 = dr.sin(2 * pi * u[2]), dr.cos(2 * pi * u[2])
    # the mean direction (cosine, 0, -sine) turned by the sampled angle, in (out, aside, along)
    out = (1 - below) * cosine + spread * c3 * sine
    along = spread * c3 * cosine - (1 - below) * sine
    flat = dr.sqrt(out * out + (spread * s3) ** 2)
    gamma = turn - k.gamma + dr.select(last, pi * (2 * u[0] - 1), logistic_sample(u[0], k.n.s))
    return k.direction(-flat * dr.sin(gamma), along, flat * dr.cos(gamma))
