"""The BSDF of a whole width: the mean of the near field's, and no energy lost."""

from __future__ import annotations

import numpy as np
import pytest

from appearance.bsdf import reference
from appearance.bsdf.far_field import azimuthal_table
from appearance.bsdf.lobes import Fibre
from appearance.scene.hair_appearance import HairAppearance


def test_without_absorption_all_light_leaves():
    hair = HairAppearance((0, 0, 0), 0.3, 0.25)
    turns = np.pi * (np.arange(2000) + 0.5) / 2000
    table = azimuthal_table(hair, np.array([0.3, 0.9]), turns)
    around = 2 * table.mean(axis=2) * np.pi
    np.testing.assert_allclose(around.sum(axis=0), 1, rtol=2e-3)


@pytest.mark.parametrize("beta_n", [0.15, 0.6])
def test_it_is_the_mean_of_the_near_field_over_the_width(beta_n):
    hair = HairAppearance((0.1, 0.3, 1.2), 0.25, beta_n, tilt_deg=3)
    h = (np.arange(20_001) + 0.5) / 20_001 * 2 - 1
    for theta_i, theta_o, turn in ((0.2, -0.3, 0.4), (-0.5, 0.4, 2.9), (0.9, -0.8, 1.7)):
        wi = reference.direction(theta_i, np.arcsin(h))
        wo = reference.direction(theta_o, np.arcsin(h) + turn)
        table = azimuthal_table(hair, np.cos([theta_i]), np.array([turn]))[:, 0, 0]
        for channel, sigma in enumerate(hair.sigma_a):
            fibre = Fibre(sigma, hair.beta_m, beta_n, hair.eta, np.radians(hair.tilt_deg))
            near = reference.evaluate(fibre, wi, wo).mean()
            tilted = [reference.tilted(p, theta_i, fibre.tilt) for p in range(4)]
            m = [
                reference.m_p(tilted[p], theta_o, reference.variance(p, hair.beta_m))
                for p in range(4)
            ]
            far = sum(m[p] * table[p, channel] for p in range(4))
            assert far == pytest.approx(near, rel=0.005)
