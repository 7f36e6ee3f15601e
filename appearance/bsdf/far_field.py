"""The hair BSDF averaged over a fibre's width, for fibres thinner than a pixel.

The offset h is uniform in [-1, 1] across a fibre. Each lobe is a longitudinal part M_p, independent
of h, times the mean over h of A_p N_p, tabulated here for the whole width or parts of it.
"""

from __future__ import annotations

from math import pi
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance.bsdf.lobes import Fibre, across, m_p, tilted, variances
from appearance.bsdf.reference import (
    LOBES,
    a_p,
    fresnel,
    logistic_scale,
    n_p,
    refracted_azimuth,
    transmission,
)
from appearance.scene.hair_appearance import HairAppearance
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import Array

OFFSETS = 512
"""Offsets h that the mean is taken over."""
COSINES, TURNS = 48, 256
"""Nodes of a `FarField`, of which the nearest counts: at grazing angles it is off by up to 10 %."""
PARTS = 2
"""Of the width of a `FarField`, which each have a mean of their own."""
LEAST_BETA_N = 0.1
"""Azimuthal lobes of less are as narrow as a node of a `FarField`."""


class FarField:
    """`lobes.evaluate` averaged over parts of the width of a fibre that is `hair` everywhere.

    The mean for rays at random offsets, with less noise. Light between the demo's fibres is 2.7 %
    too bright with the mean over the whole width, 0.5 % with halves.
    """

    def __init__(self, hair: HairAppearance) -> None:
        cosines, turns = ((np.arange(n) + 0.5) / n for n in (COSINES, TURNS))
        table = azimuthal_table(hair, cosines, pi * turns, TURNS, PARTS)
        self._table = mi.Float(for_kernels(table.transpose(0, 2, 3, 4, 1).ravel()))

    def evaluate(self, fibre: Fibre, wi: Any, wo: Any, active: Any) -> Any:
        """Mean BSDF times cosine `Color3f` from `wi` to `wo`, per steradian.

        `fibre` has the hair's parameters; both directions are in its frame, as of `evaluate`.
        """
        cosine, x, z = across(wi)
        other, x_o, z_o = across(wo)
        sines, cosines = tilted(wi.y, cosine, fibre.tilt)
        v = variances(fibre.beta_m)
        m = mi.Vector4f(*(m_p(sines[p], cosines[p], wo.y, other, v[p]) for p in range(LOBES)))
        turn = dr.acos(dr.clip(x * x_o + z * z_o, -1, 1))
        h = dr.select(z * x_o > x * z_o, x, -x)  # of turns the other way round, the mirror image's
        part = dr.minimum(mi.UInt32((h + 1) * (PARTS / 2)), PARTS - 1)
        row = part * COSINES + dr.minimum(mi.UInt32(cosine * COSINES), COSINES - 1)
        column = dr.minimum(mi.UInt32(turn * (TURNS / pi)), TURNS - 1)
        node = 3 * (row * TURNS + column)
        a_n = (dr.gather(mi.Vector4f, self._table, node + k, active) for k in range(3))
        return mi.Color3f(*(dr.dot(m, x) for x in a_n))


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
