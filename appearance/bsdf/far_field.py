"""The hair BSDF averaged over a fibre's width, for fibres thinner than a pixel.

The offset h is uniform in [-1, 1] across a fibre. Each lobe is a longitudinal part M_p, independent
of h, times the mean over h of A_p N_p, tabulated here for the whole width or parts of it.
"""

from __future__ import annotations

from collections.abc import Callable
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
COSINES, TURNS, INCLINATIONS = 64, 256, 512
"""Nodes of a `FarField`, of which the nearest counts: at grazing angles it is off by up to 10 %."""
PARTS = 2
"""Of the width of a `FarField`, which each have a mean of their own."""
LEAST_BETA_M, LEAST_BETA_N = 0.15, 0.1
"""Lobes of less are as narrow as a node of a `FarField`."""


class FarField:
    """`lobes.evaluate` averaged over parts of the width of a fibre that is `hair` everywhere.

    The mean for rays at random offsets, with less noise. Light between the demo's fibres is 2.7 %
    too bright with the mean over the whole width, 0.5 % with halves.
    """

    def __init__(self, hair: HairAppearance) -> None:
        cosines, turns = ((np.arange(n) + 0.5) / n for n in (COSINES, TURNS))
        table = azimuthal_table(hair, cosines, pi * turns, TURNS, PARTS)
        self._azimuthal = mi.Float(for_kernels(table.transpose(0, 2, 3, 4, 1).ravel()))
        theta = pi * ((np.arange(INCLINATIONS) + 0.5) / INCLINATIONS - 0.5)
        tilt = np.deg2rad(hair.tilt_deg)
        along = [
            m_p(tilted(p, theta[:, None], tilt), theta, variance(p, hair.beta_m))
            for p in range(LOBES)
        ]
        self._longitudinal = mi.Float(for_kernels(np.stack(along, -1).ravel()))

    def towards(self, wi: Any) -> Callable[[Any, Any], Any]:
        """The mean BSDF times cosine `Color3f` from `wi` to `(wo, active)`, per steradian.

        Both directions are in the fibre's frame, as of `lobes.evaluate`.
        """
        cosine, x, z = across(wi)
        inclined = INCLINATIONS * _inclination(wi)
        row = _node(cosine, COSINES)

        def value(wo: Any, active: Any) -> Any:
            _, x_o, z_o = across(wo)
            node = inclined + _inclination(wo)
            m = dr.gather(mi.Vector4f, self._longitudinal, node, active)
            turn = dr.acos(dr.clip(x * x_o + z * z_o, -1, 1))
            h = dr.select(z * x_o > x * z_o, x, -x)  # of turns the other way: the mirror image's
            line = _node(0.5 * (h + 1), PARTS) * COSINES + row
            node = 3 * (line * TURNS + _node(turn * (1 / pi), TURNS))
            a_n = (dr.gather(mi.Vector4f, self._azimuthal, node + k, active) for k in range(3))
            return mi.Color3f(*(dr.dot(m, x) for x in a_n))

        return value


def _inclination(w: Any) -> Any:
    """The nearest node to the inclination of the direction `w`."""
    return _node(dr.asin(dr.clip(w.y, -1, 1)) * (1 / pi) + 0.5, INCLINATIONS)


def _node(x: Any, count: int) -> Any:
    """The nearest of `count` nodes to `x` in [0, 1]."""
    return dr.minimum(mi.UInt32(dr.maximum(x, 0) * count), count - 1)


def azimuthal_table(
    hair: HairAppearance, cosines: Array, turns: Array, offsets: int = OFFSETS, parts: int = 1
) -> Array:
    """Means over equal `parts` of the width of A_p N_p: `(parts, LOBES, C, T, 3)`, per radian.

    `cosines (C,)` in (0, 1] are those of the inclination of the direction towards the eye, `turns
    (T,)` the angle about the fibre from it to the direction towards the light, radians.
    """
    h = (np.arange(offsets) + 0.5) / offsets * 2 - 1
    gamma = np.arcsin(h)
    theta = np.arccos(np.clip(cosines, 1e-4, 1))[:, None, None]
    f = fresnel(np.cos(theta) * np.cos(gamma), hair.eta)
    gamma_t = refracted_azimuth(theta, gamma, hair.eta)
    t = [transmission(theta, gamma, hair.eta, s) for s in hair.sigma_a]
    s = logistic_scale(hair.beta_n)
    out = np.empty((parts, LOBES, len(cosines), len(turns), 3))
    for p in range(LOBES):
        n = n_p(p, turns[None, :, None], gamma, gamma_t, s)
        for channel in range(3):
            of_parts = np.split(a_p(p, f, t[channel]) * n, parts, axis=-1)
            out[:, p, ..., channel] = np.mean(of_parts, axis=-1)
    return out
