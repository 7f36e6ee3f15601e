"""The azimuthal part of the hair BSDF averaged over a fibre's width.

The offset h is uniform in [-1, 1] across a fibre. Each lobe is a longitudinal part M_p, independent
of h, times the mean over h of A_p N_p.
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
    """Means over the width of A_p N_p: `(LOBES, C, T, 3)`, per radian.

    `cosines (C,)` in (0, 1] are those of the inclination of the direction towards the eye, `turns
    (T,)` the angle about the fibre from it to the direction towards the light, radians.
    """
    # even in the angle: at |h| = 1 TT is no polynomial of h
    gamma = np.pi * ((np.arange(OFFSETS) + 0.5) / OFFSETS - 0.5)
    weight = 0.5 * np.pi * np.cos(gamma)
    theta = np.arccos(np.clip(cosines, 1e-4, 1))[:, None, None]
    f = fresnel(np.cos(theta) * np.cos(gamma), hair.eta)
    gamma_t = refracted_azimuth(theta, gamma, hair.eta)
    t = [transmission(theta, gamma, hair.eta, s) for s in hair.sigma_a]
    s = logistic_scale(hair.beta_n)
    out = np.empty((LOBES, len(cosines), len(turns), 3))
    for p in range(LOBES):
        n = n_p(p, turns[None, :, None], gamma, gamma_t, s)
        for channel in range(3):
            out[p, ..., channel] = np.mean(a_p(p, f, t[channel]) * n * weight, axis=-1)
    return out
