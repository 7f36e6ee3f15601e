"""The fast lobes against the plain reference, and what they do at the edges."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from benchmarks.bsdf.integrals import Case, array_types, cases, fibre, known_direction, uniforms
from hypothesis import given, settings
from hypothesis import strategies as st

from appearance.bsdf import lobes, reference
from reconstruction.array_backend import for_kernels


def scattered(case: Case, count: int = 300, seed: int = 0) -> np.ndarray:
    """Directions all over the sphere, and about the middles of the lobes."""
    rng = np.random.default_rng(seed)
    theta, gamma = reference.inclination(case.wi), reference.azimuth(case.wi)
    inner = reference.refracted_azimuth(theta, gamma, case.eta)
    v = float(reference.variance(0, case.beta_m))
    s = float(reference.logistic_scale(case.beta_n))
    along = [np.arcsin(rng.uniform(-1, 1, count))]
    around = [rng.uniform(-np.pi, np.pi, count)]
    for p in range(3):
        middle = -reference.tilted(p, theta, case.optics["tilt"])
        along.append(middle + np.sqrt(v) * rng.normal(size=count))
        turn = gamma + reference.phi(p, gamma, inner)
        around.append(turn + 2 * s * rng.normal(size=count))
    return reference.direction(np.concatenate(along), np.concatenate(around))


@pytest.mark.parametrize("sigma_a", [0.0, pytest.param(0.3, marks=pytest.mark.slow), 1e4])
def test_float64_matches_the_reference(sigma_a):
    for case in cases(40, seed=3):
        # |h| = 1 at a grazing angle: the printed forms lose half their digits
        case = replace(case, sigma_a=sigma_a, h=0.999 * case.h)
        wo = scattered(case)
        known = lobes.known(fibre(case, True), known_direction(case, True))
        value, _ = lobes.evaluate_known(known, array_types(True)[1](wo.T))
        want = reference.evaluate(lobes.Fibre(sigma_a, **case.optics), case.wi, wo)
        assert np.array(value.x) == pytest.approx(want, rel=1e-6, abs=1e-9), case


@settings(deadline=None, max_examples=40, derandomize=True)
@given(
    st.floats(0.001, 1),
    st.floats(0.001, 1),
    st.floats(-90, 90),
    st.floats(-1, 1),
    st.floats(1.0001, 3),
    st.floats(-10, 10),
    st.floats(0, 1e4),
)
def test_weights_are_bounded_finite_and_not_negative(
    beta_m, beta_n, theta_deg, h, eta, tilt_deg, sigma
):
    case = Case(beta_m, beta_n, theta_deg, h, eta, tilt_deg, sigma)
    number, vector = array_types(False)
    sigma_a = vector(*(dr.opaque(number, s) for s in (0, sigma, 1e4)))
    coloured = replace(fibre(case, False), sigma_a=sigma_a)
    wi = known_direction(case, False)
    wo, pdf, weight = lobes.sample(coloured, wi, *uniforms(4000, 5, False))
    assert np.abs(np.linalg.norm(np.array(wo, float), axis=0) - 1).max() < 1e-6
    weight, pdf = np.array(weight), np.array(pdf)
    assert np.isfinite(pdf).all()
    assert (pdf > 0).all()
    assert (weight >= 0).all()
    assert weight.max() <= 3.001
    elsewhere = vector(for_kernels(scattered(case, 512).T))
    value, pdf = lobes.evaluate(coloured, wi, elsewhere)
    value, pdf = np.array(value), np.array(pdf)
    assert np.isfinite(value).all()
    assert np.isfinite(pdf).all()
    assert (value >= 0).all()
    assert (value <= 3.001 * pdf + 1e-30).all()  # float32 has no smaller normal numbers


@pytest.mark.parametrize("double", [False, True])
def test_every_uniform_number_gives_a_direction(double):
    """0 and the largest number below 1 too, for every lobe, at both ends of roughness."""
    last = 1 - 2.0**-24
    corners = np.stack(np.meshgrid(*[[0.0, 2.0**-24, 0.5, last]] * 3), -1).reshape(-1, 3)
    number, dtype = array_types(double)[0], np.float64 if double else np.float32
    for beta in (0.001, 1.0):
        for h in (0.0, 0.9, -1.0):
            for sigma in (0.0, 1e4):
                case = Case(beta, beta, theta_deg=-89.99, h=h, sigma_a=sigma)
                wi = known_direction(case, double)
                u = [number(for_kernels(c, dtype)) for c in corners.T]
                wo, pdf, weight = lobes.sample(fibre(case, double), wi, *u)
                assert np.linalg.norm(np.array(wo, float), axis=0) == pytest.approx(1, abs=1e-6)
                assert (np.array(pdf) > 0).all()
                assert np.isfinite(np.array(weight)).all()
                known = lobes.known(fibre(case, double), wi)
                for p in range(4):
                    wo = lobes.sample_lobe(known, p, *u)
                    assert (np.array(lobes.lobe(known, p, wo)) > 0).all()


def test_absorption_only_ever_takes_light_away():
    case = Case(theta_deg=30, h=0.3)
    vector = array_types(True)[1]
    wo = vector(scattered(case).T)
    before = np.inf
    for sigma in (0.0, 1e-3, 0.1, 1.0, 10.0, 1e3, 1e4):
        value, _ = lobes.evaluate(
            fibre(replace(case, sigma_a=sigma), True), known_direction(case, True), wo
        )
        assert (np.array(value.x) <= before + 1e-12).all()
        before = np.array(value.x)
    reflected = lobes.known(fibre(case, True), known_direction(case, True))
    only_r = np.array(reflected.attenuation[0] * lobes.lobe(reflected, 0, wo))
    assert before == pytest.approx(only_r)


def test_every_back_end_gives_the_same():
    """LLVM and, where there is one, CUDA."""
    case = Case(theta_deg=20, h=0.2, sigma_a=0.4, tilt_deg=3)
    wo = reference.direction(np.linspace(-1.5, 1.5, 100), np.linspace(-3, 3, 100))
    want = reference.evaluate(lobes.Fibre(0.4, **case.optics), case.wi, wo)
    modules = [dr.llvm.ad]
    if dr.has_backend(dr.JitBackend.CUDA):
        modules.append(dr.cuda.ad)
    for module in modules:
        vector = module.Array3f
        wi = vector(*map(float, case.wi))
        value, _ = lobes.evaluate(
            lobes.Fibre(vector(0.4), **case.optics), wi, vector(wo.T.astype(np.float32))
        )
        assert np.array(value.x) == pytest.approx(want, rel=1e-4, abs=1e-7)


def test_lanes_may_have_fibres_of_their_own():
    number, vector = array_types(True)
    rng = np.random.default_rng(1)
    some = [
        Case(*rng.uniform([0.05, 0.05, -80, -0.9, 1.1, -5, 0], [0.9, 0.9, 80, 0.9, 2, 5, 3]))
        for _ in range(20)
    ]
    wo = reference.direction(rng.uniform(-1.5, 1.5, 20), rng.uniform(-3, 3, 20))
    fibres = lobes.Fibre(
        vector(number([c.sigma_a for c in some])),
        **{n: number([c.optics[n] for c in some]) for n in some[0].optics},
    )
    value, _ = lobes.evaluate(fibres, vector(np.stack([c.wi for c in some], -1)), vector(wo.T))
    for i, case in enumerate(some):
        want = reference.evaluate(lobes.Fibre(case.sigma_a, **case.optics), case.wi, wo[i])
        assert np.array(value.x)[i] == pytest.approx(float(want))
