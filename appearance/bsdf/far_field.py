"""The hair BSDF of a whole fibre's width: what one pixel sees of a fibre thinner than it.

Seen across, a fibre shows every offset h in [-1, 1] alike. Each lobe is a longitudinal part M_p,
which does not depend on h, times the mean over h of A_p N_p, which is tabulated here.
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
LEAST_BETA_N = 0.1
"""Azimuthal lobes of less are as narrow as a node of a `FarField`."""


class FarField:
    """`lobes.evaluate` averaged over the width of a fibre that is `hair` everywhere, in Dr.Jit.

    A ray that meets the fibre anywhere in its width finds this in the mean, and less noise.
    """

    def __init__(self, hair: HairAppearance) -> None:
        cosines, turns = ((np.arange(n) + 0.5) / n for n in (COSINES, TURNS))
        table = azimuthal_table(hair, cosines, pi * turns, TURNS)
        self._table = mi.Float(for_kernels(table.transpose(1, 2, 3, 0).ravel()))

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
        row = dr.minimum(mi.UInt32(cosine * COSINES), COSINES - 1)
        column = dr.minimum(mi.UInt32(turn * (TURNS / pi)), TURNS - 1)
        node = 3 * (row * TURNS + column)
        a_n = (dr.gather(mi.Vector4f, self._table, node + k, active) for k in range(3))
        return mi.Color3f(*(dr.dot(m, x) for x in a_n))


def azimuthal_table(
    hair: HairAppearance, cosines: Array, turns: Array, offsets: int = OFFSETS
) -> Array:
    """Mean over the width of A_p N_p: `(LOBES, C, T, 3)`, per radian.

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
    out = np.empty((LOBES, len(cosines), len(turns), 3))
    for p in range(LOBES):
        # the sign of the turn is that of h, over which the mean is symmetric
        n = n_p(p, turns[None, :, None], gamma, gamma_t, s)
        for channel in range(3):
            out[p, ..., channel] = (a_p(p, f, t[channel]) * n).mean(axis=-1)
    return out
