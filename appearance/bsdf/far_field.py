"""The hair BSDF averaged over a fibre's width, for fibres thinner than a pixel.

The offset h is uniform in [-1, 1] across a fibre. Each lobe is a longitudinal part M_p, independent
of h, times the mean over h of A_p N_p, tabulated here for the whole width or parts of it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from math import pi
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance.bsdf.lobes import across
from appearance.bsdf.reference import (
    LOBES,
    a_p,
    fresnel,
    logistic_scale,
    m_p,
    n_p,
    refracted_azimuth,
    tilted,
    transmission,
    variance,
)
from appearance.scene.hair_appearance import HairAppearance
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import Array

OFFSETS = 512
"""Offsets h that the mean is taken over."""
COSINES, TURNS = 64, 256
"""Nodes of the azimuthal part of a `FarField`, linear in between over turns."""
SLOPES, INCLINATIONS = 1024, 256
"""Nodes of its longitudinal part by inclination of wi and wo, linear in between over wo's."""
_SLICES = 16
PARTS = 4
"""Of the width of a `FarField`, which each have a mean of their own."""
LEAST_BETA_M, LEAST_BETA_N = 0.15, 0.1
"""Lobes of less are as narrow as a node of a `FarField`."""


class FarField:
    """`lobes.evaluate` averaged over parts of the width of a fibre that is `hair` everywhere.

    The mean for rays at random offsets, with less noise. The visible and the lit parts
    of a fibre are not independent: direct light on the demo's hair is 5 % too bright with halves of
    the width, 1.0 % with quarters, 0.5 % with eighths.
    """

    def __init__(self, hair: HairAppearance) -> None:
        azimuthal, longitudinal = _tables(hair)
        self._azimuthal = mi.Float(for_kernels(azimuthal))
        self._longitudinal = mi.Float(for_kernels(longitudinal))

    def towards(self, wi: Any) -> Callable[[Any, Any], Any]:
        """The mean BSDF times cosine `Color3f` from `wi` to `(wo, active)`, per steradian.

        Both directions are in the fibre's frame, as of `lobes.evaluate`.
        """
        cosine, x, z = across(wi)
        inclined = (INCLINATIONS + 1) * _node(_inclination(wi), SLOPES)
        row = _node(cosine, COSINES)

        def value(wo: Any, active: Any) -> Any:
            _, x_o, z_o = across(wo)
            m = _between(self._longitudinal, inclined, _inclination(wo), INCLINATIONS, 1, active)[0]
            turn = dr.acos(dr.clip(x * x_o + z * z_o, -1, 1)) * (1 / pi)
            h = dr.select(z * x_o > x * z_o, x, -x)  # of turns the other way: the mirror image's
            line = 3 * (TURNS + 1) * (_node(0.5 * (h + 1), PARTS) * COSINES + row)
            a_n = _between(self._azimuthal, line, turn, TURNS, 3, active)
            return mi.Color3f(*(dr.dot(m, x) for x in a_n))

        return value


def _inclination(w: Any) -> Any:
    """The inclination of the direction `w`, from 0 to 1."""
    return dr.asin(dr.clip(w.y, -1, 1)) * (1 / pi) + 0.5


def _node(x: Any, count: int) -> Any:
    """The nearest of `count` nodes to `x` in [0, 1]."""
    return dr.minimum(mi.UInt32(dr.maximum(x, 0) * count), count - 1)


def _between(
    table: Any, first: Any, x: Any, intervals: int, channels: int, active: Any
) -> list[Any]:
    """`channels` vectors of `table`, linear between the nodes from `first` on, at `x` in [0, 1]."""
    k = _node(x, intervals)
    share = dr.clip(x * intervals - mi.Float(k), 0, 1)
    node = first + channels * k

    def at(c: int) -> Any:
        return dr.gather(mi.Vector4f, table, node + c, active)

    return [at(c) + share * (at(c + channels) - at(c)) for c in range(channels)]


@lru_cache(maxsize=4)
def _tables(hair: HairAppearance) -> tuple[Array, Array]:
    """Both parts, flat: a second of work, for the same hair in view after view."""
    cosines = (np.arange(COSINES) + 0.5) / COSINES
    turns = np.linspace(0, pi, TURNS + 1)
    # a few cosines at a time: all together take 300 MB
    few = [
        azimuthal_table(hair, x, turns, OFFSETS // 2, PARTS)
        for x in np.array_split(cosines, _SLICES)
    ]
    table = np.concatenate(few, axis=2)
    theta_i = pi * ((np.arange(SLOPES) + 0.5) / SLOPES - 0.5)
    theta_o = np.linspace(-pi / 2, pi / 2, INCLINATIONS + 1)
    tilt = np.deg2rad(hair.tilt_deg)
    along = [
        m_p(tilted(p, theta_i[:, None], tilt), theta_o, variance(p, hair.beta_m))
        for p in range(LOBES)
    ]
    return table.transpose(0, 2, 3, 4, 1).ravel(), np.stack(along, -1).ravel()


def azimuthal_table(
    hair: HairAppearance, cosines: Array, turns: Array, offsets: int = OFFSETS, parts: int = 1
) -> Array:
    """Means over equal `parts` of the width of A_p N_p: `(parts, LOBES, C, T, 3)`, per radian.

    `cosines (C,)` in (0, 1] are those of the inclination of the direction towards the eye, `turns
    (T,)` the angle about the fibre from it to the direction towards the light, radians.
    """
    # even in the angle within each part: at |h| = 1 TT is no polynomial of h
    edges = np.arcsin(np.linspace(-1, 1, parts + 1))
    steps = (np.arange(offsets // parts) + 0.5) / (offsets // parts)
    gamma = (edges[:-1, None] + np.diff(edges)[:, None] * steps).ravel()
    weight = np.cos(gamma) * np.repeat(np.diff(edges), len(steps)) * 0.5 * parts
    theta = np.arccos(np.clip(cosines, 1e-4, 1))[:, None, None]
    f = fresnel(np.cos(theta) * np.cos(gamma), hair.eta)
    gamma_t = refracted_azimuth(theta, gamma, hair.eta)
    t = [transmission(theta, gamma, hair.eta, s) for s in hair.sigma_a]
    s = logistic_scale(hair.beta_n)
    out = np.empty((parts, LOBES, len(cosines), len(turns), 3))
    for p in range(LOBES):
        n = n_p(p, turns[None, :, None], gamma, gamma_t, s)
        for channel in range(3):
            of_parts = np.split(a_p(p, f, t[channel]) * n * weight, parts, axis=-1)
            out[:, p, ..., channel] = np.mean(of_parts, axis=-1)
    return out
