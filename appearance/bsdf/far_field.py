"""The hair BSDF of a whole fibre's width: what one pixel sees of a fibre thinner than it.

Seen across, a fibre shows every offset h in [-1, 1] alike. Each lobe is a longitudinal part M_p,
which does not depend on h, times the mean over h of A_p N_p, which is tabulated here.
"""

from __future__ import annotations

import numpy as np

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
from reconstruction.arrays import Array

OFFSETS = 512
"""Offsets h that the mean is taken over."""


def azimuthal_table(hair: HairAppearance, cosines: Array, turns: Array) -> Array:
    """Mean over the width of A_p N_p: `(LOBES, C, T, 3)`, per radian.

    `cosines (C,)` in (0, 1] are those of the inclination of the direction towards the eye, `turns
    (T,)` the angle about the fibre from it to the direction towards the light, radians.
    """
    h = (np.arange(OFFSETS) + 0.5) / OFFSETS * 2 - 1
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
