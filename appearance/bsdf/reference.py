"""The hair BSDF in plain float64 NumPy, one function per symbol, as the papers print it.

Chiang et al. 2016 with near-field h, on the symbols of pbrt. Slow and readable: the other side of
the tests of `appearance.bsdf.lobes`, which has the stable forms. Everything broadcasts.

Directions are `(..., 3)` in the fibre's frame: +y along the fibre from root to tip, +z the surface
normal. `wi` is the direction known so far (towards the eye), `wo` the one that is evaluated.
theta is the inclination towards +y, gamma the azimuth about the fibre, 0 at the normal and positive
towards -x. The lobes p are R, TT, TRT and the residual: everything that leaves later.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit

from appearance.bsdf.lobes import Fibre
from appearance.bsdf.longitudinal import longitudinal, variance_of_roughness
from reconstruction.arrays import Array

LOBES = 4


def inclination(w: ArrayLike) -> Array:
    """theta of the directions `w (..., 3)`."""
    w = np.asarray(w, float)
    return np.arctan2(w[..., 1], np.hypot(w[..., 0], w[..., 2]))


def azimuth(w: ArrayLike) -> Array:
    """gamma of the directions `w (..., 3)`; h, where a ray meets the fibre across, is its sine."""
    w = np.asarray(w, float)
    return np.arctan2(-w[..., 0], w[..., 2])


def direction(theta: ArrayLike, gamma: ArrayLike) -> Array:
    """The direction `(..., 3)` of an inclination and an azimuth."""
    theta, gamma = np.broadcast_arrays(theta, gamma)
    flat = np.cos(theta)
    return np.stack([-flat * np.sin(gamma), np.sin(theta), flat * np.cos(gamma)], axis=-1)


def variance(p: int, beta_m: ArrayLike) -> Array:
    """v of lobe `p`, of the shape of `beta_m`: Chiang's map, a quarter for TT, four for TRT."""
    return np.asarray((1, 0.25, 4, 4)[p] * variance_of_roughness(beta_m))


def logistic_scale(beta_n: ArrayLike) -> Array:
    """s, of the shape of `beta_n`: Chiang's map to the scale of a logistic distribution."""
    b = np.asarray(beta_n, float)
    return np.asarray(np.sqrt(np.pi / 8) * (0.265 * b + 1.194 * b**2 + 5.372 * b**22))


def tilted(p: int, theta: ArrayLike, tilt: ArrayLike) -> Array:
    """theta, of any shape, of lobe `p` under a cuticle tilt, folded into [-pi/2, pi/2]."""
    turned = np.asarray(theta, float) + (2, -1, -4, 0)[p] * np.asarray(tilt, float)
    return np.arcsin(np.sin(turned))


def m_p(theta_i: ArrayLike, theta_o: ArrayLike, v: ArrayLike) -> Array:
    """M_p: the longitudinal lobe (d'Eon 2011, eq. 7), of unit integral over cos(theta_o) dtheta_o.

    Arguments broadcast to one shape. `appearance.bsdf.longitudinal` has it, and is tested against
    arbitrary precision.
    """
    return longitudinal(theta_i, theta_o, v)


def refracted_azimuth(theta: ArrayLike, gamma: ArrayLike, eta: ArrayLike) -> Array:
    """gamma_t inside the fibre, by Bravais' modified index eta'; arguments of any one shape."""
    eta_p = np.sqrt(np.asarray(eta, float) ** 2 - np.sin(theta) ** 2) / np.cos(theta)
    return np.arcsin(np.sin(gamma) / eta_p)


def refracted_inclination(theta: ArrayLike, eta: ArrayLike) -> Array:
    """theta_t inside the fibre, of the shape of `theta`."""
    return np.arcsin(np.sin(theta) / np.asarray(eta, float))


def phi(p: int, gamma: ArrayLike, gamma_t: ArrayLike) -> Array:
    """Phi_p, of the shape of `gamma`: how far lobe `p` turns the azimuth in a smooth fibre."""
    return np.asarray(2 * p * np.asarray(gamma_t, float) - 2 * np.asarray(gamma) + p * np.pi)


def logistic(x: ArrayLike, s: ArrayLike) -> Array:
    """Logistic density of scale `s` at `x` of any shape."""
    z = np.exp(-np.abs(x) / s)
    return np.asarray(z / (s * (1 + z) ** 2))


def n_p(p: int, turn: ArrayLike, gamma: ArrayLike, gamma_t: ArrayLike, s: ArrayLike) -> Array:
    """N_p: density of the turn gamma_o - gamma_i; a logistic trimmed to [-pi, pi] about Phi_p.

    Arguments broadcast to one shape.
    """
    s = np.asarray(s, float)
    if p == LOBES - 1:
        return np.full(np.broadcast(turn, gamma, s).shape, 0.5 / np.pi)
    x = np.asarray(turn, float) - phi(p, gamma, gamma_t)
    x = x - 2 * np.pi * np.round(x / (2 * np.pi))
    return np.asarray(logistic(x, s) / (expit(np.pi / s) - expit(-np.pi / s)))


def fresnel(mu: ArrayLike, eta: ArrayLike) -> Array:
    """F, of the shape of `mu`: unpolarised reflectance at the cosine `mu` to the normal."""
    mu, eta = np.asarray(mu, float), np.asarray(eta, float)
    inside = np.sqrt(1 - (1 - mu**2) / eta**2)
    s = (mu - eta * inside) / (mu + eta * inside)
    p = (eta * mu - inside) / (eta * mu + inside)
    return np.asarray((s**2 + p**2) / 2)


def a_p(p: int, f: ArrayLike, t: ArrayLike) -> Array:
    """A_p, of the shape of `f`: light that leaves by lobe `p`, `t` of it transmitted a crossing."""
    f, t = np.asarray(f, float), np.asarray(t, float)
    if p == 0:
        return np.broadcast_to(f, np.broadcast(f, t).shape)
    share = (1 - f) ** 2 * t * (f * t) ** (p - 1)
    return np.asarray(share if p < LOBES - 1 else share / (1 - f * t))


def transmission(theta: ArrayLike, gamma: ArrayLike, eta: ArrayLike, sigma_a: ArrayLike) -> Array:
    """T, of the shape of `theta`: what absorption leaves of light that crosses the fibre once."""
    gamma_t = refracted_azimuth(theta, gamma, eta)
    length = 2 * np.cos(gamma_t) / np.cos(refracted_inclination(theta, eta))
    return np.exp(-np.asarray(sigma_a, float) * length)


def lobe(p: int, fibre: Fibre, wi: ArrayLike, wo: ArrayLike) -> Array:
    """M_p N_p `(...)`: the density by solid angle of lobe `p` towards `wo (..., 3)`, integral 1."""
    theta, gamma = inclination(wi), azimuth(wi)
    m = m_p(tilted(p, theta, fibre.tilt), inclination(wo), variance(p, fibre.beta_m))
    gamma_t = refracted_azimuth(theta, gamma, fibre.eta)
    return m * n_p(p, azimuth(wo) - gamma, gamma, gamma_t, logistic_scale(fibre.beta_n))


def evaluate(fibre: Fibre, wi: ArrayLike, wo: ArrayLike) -> Array:
    """BSDF times cosine `(...)`: sum of A_p M_p N_p, per steradian.

    `wi`, `wo` `(..., 3)` are unit directions; the fibre's `sigma_a` is that of one channel.
    """
    theta, gamma = inclination(wi), azimuth(wi)
    f = fresnel(np.cos(theta) * np.abs(np.cos(gamma)), fibre.eta)
    t = transmission(theta, gamma, fibre.eta, fibre.sigma_a)
    return np.asarray(sum(a_p(p, f, t) * lobe(p, fibre, wi, wo) for p in range(LOBES)))
