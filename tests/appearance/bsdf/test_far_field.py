"""The BSDF of a whole width: the mean of the near field's, and no energy lost."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from appearance.bsdf import reference
from appearance.bsdf.far_field import azimuthal_table
from appearance.bsdf.lobes import PARTS, Fibre, mean_over_width
from appearance.scene.backend import ensure_backend
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


@pytest.mark.parametrize("beta_m", [0.05, 0.3, 1.0])
def test_over_all_offsets_it_is_the_near_fields_mean_over_each_part_of_the_width(beta_m):
    """Directions along the fibre, grazing, and onto the middle of TT among them."""
    ensure_backend()
    sigma_a, tilt, beta_n = (0.1, 0.3, 1.2), np.radians(2), 0.3
    rng = np.random.default_rng(1)
    count, offsets = 60, 512
    theta_i, theta_o = rng.uniform(-1.5, 1.5, (2, count))
    theta_o[:30] = -theta_i[:30]
    turn = rng.uniform(-np.pi, np.pi, count)
    turn[:3] = 0, np.pi, -np.pi
    part = rng.integers(0, PARTS, count)
    h = (part[:, None] + (np.arange(offsets) + 0.5) / offsets) * 2 / PARTS - 1
    wi = reference.direction(theta_i[:, None], np.arcsin(h))
    wo = reference.direction(theta_o[:, None], np.arcsin(h) + turn[:, None])
    want = [reference.evaluate(Fibre(s, beta_m, beta_n, 1.55, tilt), wi, wo) for s in sigma_a]
    one, other = (mi.Vector3f(*x.reshape(-1, 3).T) for x in (wi, wo))
    got = mean_over_width(Fibre(mi.Color3f(*sigma_a), beta_m, beta_n, 1.55, tilt), one)(other)
    mean = np.array(got).reshape(3, count, offsets).mean(axis=2)
    np.testing.assert_allclose(mean, np.mean(want, axis=2), rtol=1e-5, atol=1e-8)
    spread = np.array(got).reshape(3, count, offsets).std(axis=2).mean()
    assert spread < 0.4 * np.std(want, axis=2).mean()


def test_directions_along_the_fibre_and_on_its_edges_are_finite():
    ensure_backend()
    fibre = Fibre(mi.Color3f(0), 0.001, 0.001, 1.55, 0.0)
    wi = mi.Vector3f([0, 0, 1, -1], [1, -1, 0, 0], [0, 0, 0, 0])
    got = np.array(mean_over_width(fibre, wi)(mi.Vector3f(0, 0.6, 0.8)))
    assert np.isfinite(got).all()
