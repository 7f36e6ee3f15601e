"""Samples follow the density that they claim: chi-square and first moments, lobe by lobe."""

from itertools import pairwise

import numpy as np
import pytest
from benchmarks.bsdf.integrals import (
    Case,
    array_types,
    fibre,
    integral,
    known_direction,
    panels,
    uniforms,
)
from scipy.stats import chi2

from appearance.bsdf import lobes, reference

SAMPLES = 100_000
CELLS = 16
CASES = [
    Case(0.3, 0.3, 30, 0.3),
    Case(0.001, 0.001, -60, 0.7, tilt_deg=3),
    Case(0.03, 0.1, 89.9, -0.5, eta=1.3, tilt_deg=-10),
    Case(0.6, 0.6, 0, 1.0, tilt_deg=10),
    Case(1.0, 1.0, -45, -0.99, eta=1.01),
    Case(0.1, 0.01, 80, 0.999, eta=3.0),
]
PER_LOBE = pytest.mark.parametrize(
    ("case", "p"), [(case, p) for case in CASES for p in range(reference.LOBES)]
)


def drawn(case, p):
    """Directions `(N, 3)` of lobe `p`; of all lobes, as they are chosen, without a `p`."""
    u = uniforms(SAMPLES, 7, False)
    if p is None:
        return np.array(lobes.sample(fibre(case, False), known_direction(case, False), *u)[0]).T
    known = lobes.known(fibre(case, False), known_direction(case, False))
    return np.array(lobes.sample_lobe(known, p, *u)).T


def shares(case):
    """Probabilities of the lobes."""
    theta, gamma = reference.inclination(case.wi), reference.azimuth(case.wi)
    f = reference.fresnel(case.wi[2], case.eta)
    t = reference.transmission(theta, gamma, case.eta, case.sigma_a)
    a = np.array([float(reference.a_p(p, f, t)) for p in range(4)]) if f < 1 else np.eye(4)[0]
    return a / a.sum()


def probabilities(case, p, along, around):
    """Probability of lobe `p` in each cell between the edges `along`, `around` (in radians)."""
    theta, gamma = reference.inclination(case.wi), reference.azimuth(case.wi)
    inner = reference.refracted_azimuth(theta, gamma, case.eta)
    theta_p = float(reference.tilted(p, theta, case.optics["tilt"]))
    v, s = reference.variance(p, case.beta_m), float(reference.logistic_scale(case.beta_n))
    middle = float(gamma + reference.phi(p, gamma, inner)) % (2 * np.pi)
    middles = [middle + np.pi * k for k in range(-3, 3)]

    def rows():
        for low, high in pairwise(along):
            nodes, weights = panels([-theta_p], [float(np.sqrt(v))], low, high)
            yield reference.m_p(theta_p, nodes, v) @ (weights * np.cos(nodes))

    def columns():
        for low, high in pairwise(around):
            nodes, weights = panels(middles, [s] * len(middles), low, high)
            yield reference.n_p(p, nodes - gamma, gamma, inner, s) @ weights

    return np.outer(list(rows()), list(columns()))


def chi_square(directions, expected):
    """p-value of the counts of `directions` in cells of probability `expected(along, around)`."""
    theta, gamma = reference.inclination(directions), reference.azimuth(directions)
    inner = np.linspace(0, 1, CELLS + 1)[1:-1]
    along = [-np.pi / 2, *np.unique(np.quantile(theta[::2], inner)), np.pi / 2]
    around = [-np.pi, *np.unique(np.quantile(gamma[::2], inner)), np.pi]
    # the edges come from half of the samples, the counts from the other half
    counts, _, _ = np.histogram2d(theta[1::2], gamma[1::2], bins=[along, around])
    mean = expected(along, around) * counts.sum()
    assert mean.sum() == pytest.approx(counts.sum(), rel=1e-4)
    large = mean > 5
    pooled = (counts[~large].sum() - mean[~large].sum()) ** 2 / max(mean[~large].sum(), 1)
    statistic = ((counts - mean)[large] ** 2 / mean[large]).sum() + pooled
    return chi2.sf(statistic, large.sum())


def test_chi_square_finds_a_lobe_that_is_a_twentieth_too_wide():
    case = CASES[0]
    wider = Case(1.05 * case.beta_m, case.beta_n, case.theta_deg, case.h)
    assert chi_square(drawn(wider, 2), lambda *e: probabilities(case, 2, *e)) < 1e-5


@PER_LOBE
def test_samples_of_a_lobe_pass_chi_square(case, p):
    assert chi_square(drawn(case, p), lambda *e: probabilities(case, p, *e)) > 1e-4


@pytest.mark.parametrize("case", CASES)
def test_samples_of_all_lobes_pass_chi_square_without_absorption(case):
    def expected(*edges):
        return sum(s * probabilities(case, p, *edges) for p, s in enumerate(shares(case)))

    assert chi_square(drawn(case, None), expected) > 1e-4


@PER_LOBE
def test_mean_direction_of_a_lobe_is_its_first_moment(case, p):
    """Of the directions, and of their squares along the fibre."""
    known = lobes.known(fibre(case, True), known_direction(case, True))

    def moments(w):
        return np.stack([np.array(lobes.lobe(known, p, w) * x) for x in (w.x, w.y, w.z, w.y * w.y)])

    directions = drawn(case, p).astype(float)
    values = np.column_stack([directions, directions[:, 1] ** 2])
    error = values.mean(0) - integral(case, moments, True)
    allowed = 4.5 * values.std(0) / np.sqrt(SAMPLES) + 1e-6
    assert (np.abs(error) < allowed).all(), (error, allowed)


def test_no_sample_falls_exactly_in_the_normal_plane():
    """Where a sampler that forgets its residual lobe puts that lobe's samples."""
    case = Case(0.3, 0.3, 20, 0.9)
    assert shares(case)[3] > 0.01
    assert np.mean(np.abs(drawn(case, None)[:, 1]) < 1e-5) < 1e-4


def test_lobes_are_chosen_as_often_as_they_should_be():
    number, _ = array_types(False)
    for choice in (
        [0.2, 0.5, 0.2, 0.1],
        [1.0, 0, 0, 0],
        [0.3, 0.7, 0, 0],
        [1e-12, 1 - 1e-12, 0, 0],
    ):
        past, u = lobes.choose([number(c) for c in choice], uniforms(SAMPLES, 3, False)[0])
        lobe = np.sum([np.array(p) for p in past], axis=0) * np.ones(SAMPLES, int)
        counts = np.bincount(lobe, minlength=4) / SAMPLES
        assert counts == pytest.approx(choice, abs=4.5 * 0.5 / np.sqrt(SAMPLES))
        u = np.array(u)
        assert u.min() >= 0
        assert u.max() <= 1
        for p in np.flatnonzero(counts > 0.05):
            assert u[lobe == p].mean() == pytest.approx(0.5, abs=0.02)
