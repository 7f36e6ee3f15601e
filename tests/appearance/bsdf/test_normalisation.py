"""Integrals of the symbols: M_p and N_p are densities, the A_p share one whole."""

import drjit as dr
import numpy as np
import pytest
from benchmarks.bsdf.integrals import Case, panels

from appearance.bsdf import lobes, reference

BETAS = [0.001, 0.003, 0.01, 0.1, 0.3, 0.6, 1.0]
THETAS = np.radians([-89.99, -85.0, -45.0, 0.0, 10.0, 80.0, 89.9, 89.99])
ETAS = [1.0001, 1.01, 1.3, 1.55, 2.0, 3.0]
HS = [-1.0, -0.9999999, -0.7, 0.0, 0.3, 0.99, 1.0]


@pytest.mark.parametrize("beta_m", BETAS)
@pytest.mark.parametrize("tilt_deg", [-10.0, 0.0, 10.0])
def test_longitudinal_lobes_integrate_to_one(beta_m, tilt_deg):
    number, each = dr.llvm.ad.Float64, lambda x: dr.opaque(dr.llvm.ad.Float64, x)
    for theta in THETAS:
        for p in range(4):
            theta_p = float(reference.tilted(p, theta, np.radians(tilt_deg)))
            v = float(reference.variance(p, beta_m))
            nodes, weights = panels([-theta_p], [np.sqrt(v)], -np.pi / 2, np.pi / 2)
            weights = weights * np.cos(nodes)
            assert reference.m_p(theta_p, nodes, v) @ weights == pytest.approx(1, abs=1e-6)
            ours = lobes.Longitudinal.of(each(v)).at(
                *(each(np.sin(theta_p)), each(np.cos(theta_p))),
                *(number(np.sin(nodes)), number(np.cos(nodes))),
            )
            assert np.array(ours) @ weights == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("beta_n", BETAS)
def test_azimuthal_lobes_integrate_to_one(beta_n):
    number, s = dr.llvm.ad.Float64, float(reference.logistic_scale(beta_n))
    for eta in ETAS:
        for gamma in np.arcsin(HS):
            for p in range(3):
                inner = reference.refracted_azimuth(0.4, gamma, eta)
                middle = float(reference.phi(p, gamma, inner))
                nodes, weights = panels([middle], [s], middle - np.pi, middle + np.pi)
                got = reference.n_p(p, nodes, gamma, inner, s)
                assert got @ weights == pytest.approx(1, abs=1e-6)
                ours = lobes.Azimuthal.of(dr.opaque(number, s)).at(number(nodes - middle))
                assert np.array(ours) @ weights == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("eta", ETAS)
def test_shares_add_up_to_one_without_absorption_and_to_less_with_it(eta):
    theta, h, sigma = np.meshgrid(THETAS, HS, [0.0, 1e-6, 0.1, 3.0, 1e4], indexing="ij")
    gamma, flat = np.arcsin(h), np.cos(theta)
    mu = flat * np.abs(np.cos(gamma))
    f = reference.fresnel(mu, eta)
    t = reference.transmission(theta, gamma, eta, sigma)
    with np.errstate(invalid="ignore"):  # as printed the residual is 0/0 where nothing enters
        total = sum(reference.a_p(p, f, t) for p in range(4))
    inside = f < 1
    assert (total[inside] <= 1 + 1e-9).all()
    assert total[inside & (sigma == 0)] == pytest.approx(1, abs=1e-6)
    for number, most in ((dr.llvm.ad.Float64, 1e-12), (dr.llvm.ad.Float, 1e-6)):
        index, cos_gamma = dr.opaque(number, eta), number(np.cos(gamma).ravel())
        f, through = lobes.fresnel(number(mu.ravel()), index)
        across = (number(flat.ravel()), number(h.ravel()), cos_gamma)
        _, length = lobes.refraction(*across, index)
        shares = lobes.attenuations(f, through, number(sigma.ravel()) * length)
        assert all((np.array(a) >= 0).all() for a in shares)
        ours = np.array(sum(shares)).reshape(sigma.shape)
        assert (ours <= 1 + most).all()
        assert ours[sigma == 0] == pytest.approx(1, abs=most)


def test_the_printed_reference_and_the_stable_form_share_light_alike():
    for case in (Case(theta_deg=60, h=0.4), Case(theta_deg=-89.9, h=0.999, eta=1.01)):
        theta, gamma = reference.inclination(case.wi), reference.azimuth(case.wi)
        f, through = lobes.fresnel(case.wi[2], case.eta)
        inner, length = lobes.refraction(np.cos(theta), case.h, np.cos(gamma), case.eta)
        assert inner == pytest.approx(float(reference.refracted_azimuth(theta, gamma, case.eta)))
        for sigma in (0.0, 0.3, 40.0):
            t = reference.transmission(theta, gamma, case.eta, sigma)
            ours = lobes.attenuations(f, through, sigma * length)
            for p in range(4):
                assert ours[p] == pytest.approx(float(reference.a_p(p, f, t)), rel=1e-9, abs=1e-300)
