"""The BSDF of a whole width: the mean of the near field's, and no energy lost."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from appearance.bsdf import reference
from appearance.bsdf.far_field import PARTS, FarField, azimuthal_table
from appearance.bsdf.lobes import Fibre
from appearance.scene.backend import ensure_backend
from appearance.scene.hair_appearance import HairAppearance
from appearance.scene.hair_scene import mitsuba_hair


def test_without_absorption_all_light_leaves():
    hair = HairAppearance((0, 0, 0), 0.3, 0.25)
    turns = np.pi * (np.arange(2000) + 0.5) / 2000
    (table,) = azimuthal_table(hair, np.array([0.3, 0.9]), turns)
    around = 2 * table.mean(axis=2) * np.pi
    np.testing.assert_allclose(around.sum(axis=0), 1, rtol=2e-3)


@pytest.mark.parametrize("beta_n", [0.15, 0.6])
def test_it_is_the_mean_of_the_near_field_over_the_width(beta_n):
    hair = HairAppearance((0.1, 0.3, 1.2), 0.25, beta_n, tilt_deg=3)
    h = (np.arange(20_001) + 0.5) / 20_001 * 2 - 1
    for theta_i, theta_o, turn in ((0.2, -0.3, 0.4), (-0.5, 0.4, 2.9), (0.9, -0.8, 1.7)):
        wi = reference.direction(theta_i, np.arcsin(h))
        wo = reference.direction(theta_o, np.arcsin(h) + turn)
        table = azimuthal_table(hair, np.cos([theta_i]), np.array([turn]))[0, :, 0, 0]
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


@pytest.mark.parametrize(
    "beta_m", [0.15, *(pytest.param(b, marks=pytest.mark.slow) for b in (0.3, 1.0))]
)
def test_the_table_on_the_device_gives_the_near_fields_mean_over_a_part_of_the_width(beta_m):
    """Directions along the fibre, grazing, and onto the middle of TT among them."""
    ensure_backend()
    hair = HairAppearance((0.1, 0.3, 1.2), beta_m, 0.3, tilt_deg=2)
    tilt = np.radians(hair.tilt_deg)
    rng = np.random.default_rng(1)
    theta_i, theta_o = rng.uniform(-1.5, 1.5, (2, 200))
    theta_o[:100] = -theta_i[:100]
    turn = rng.uniform(-np.pi, np.pi, 200)
    turn[:3] = 0, np.pi, -np.pi
    gamma = rng.uniform(-1.5, 1.5, 200)
    part = np.floor((np.sin(gamma)[:, None] + 1) * PARTS / 2)
    h = (part + (np.arange(2_001) + 0.5) / 2_001) * 2 / PARTS - 1
    want = [
        [
            reference.evaluate(
                Fibre(sigma, beta_m, hair.beta_n, hair.eta, tilt),
                reference.direction(i, np.arcsin(half)),
                reference.direction(o, np.arcsin(half) + t),
            ).mean()
            for sigma in hair.sigma_a
        ]
        for i, o, t, half in zip(theta_i, theta_o, turn, h, strict=True)
    ]
    wi, wo = (
        mi.Vector3f(*np.array([reference.direction(x, y) for x, y in zip(*a, strict=True)]).T)
        for a in ((theta_i, gamma), (theta_o, gamma + turn))
    )
    got = np.array(FarField(hair).towards(wi)(wo, mi.Bool(True))).T
    np.testing.assert_allclose(got, want, rtol=0.06, atol=2e-3)
    assert got.mean() == pytest.approx(np.mean(want), rel=0.002)


def test_directions_along_the_fibre_and_no_directions_are_finite_or_left_alone():
    ensure_backend()
    hair = HairAppearance((0, 0, 0), 0.001, 0.001)
    along = mi.Vector3f([0, 0, 1, np.nan], [1, -1, 0, 0], [0, 0, 0, 0])
    active = mi.Bool([True, True, True, False])
    got = np.array(FarField(hair).towards(along)(mi.Vector3f(0, 0.6, 0.8), active))
    assert np.isfinite(got[:, :3]).all()


@pytest.mark.parametrize(("roughness", "used"), [(0.14, False), (0.16, True)])
def test_fibres_with_lobes_narrower_than_a_node_are_scattered_near_field(roughness, used):
    ensure_backend()
    hair = HairAppearance((0.1, 0.3, 1.2), roughness, 0.3)
    assert (mi.load_dict(mitsuba_hair(hair)).parameters.far_field is not None) == used
