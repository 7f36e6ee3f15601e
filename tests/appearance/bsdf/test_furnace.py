"""The white furnace: hair that absorbs nothing returns all light, whatever its parameters."""

import drjit as dr
import numpy as np
import pytest
from benchmarks.bsdf.integrals import (
    Case,
    array_types,
    cases,
    fibre,
    integral,
    known_direction,
    uniforms,
)

from appearance.bsdf import lobes


def by_evaluation(case: Case, double: bool) -> np.ndarray:
    """Integrals of the BSDF times cosine and of the density."""
    known = lobes.known(fibre(case, double), known_direction(case, double))

    def both(w):
        value, pdf = lobes.evaluate_known(known, w)
        return np.stack([np.array(value.x), np.array(pdf)])

    return integral(case, both, double)


def by_sampling(case: Case, double: bool, count: int = 20_000) -> tuple[float, float]:
    """Mean and greatest deviation from 1 of the weights."""
    _, pdf, weight = lobes.sample(
        fibre(case, double), known_direction(case, double), *uniforms(count, 0, double)
    )
    weights = np.array(weight, float)
    assert (np.array(pdf) > 0).all()
    return float(weights.mean()), float(np.abs(weights - 1).max())


@pytest.mark.parametrize(("double", "most"), [(False, 1e-3), (True, 1e-7)])
def test_white_furnace_by_evaluation_at_the_ends_of_every_range(double, most):
    for case in cases(6):
        assert by_evaluation(case, double) == pytest.approx(1, abs=most), case


@pytest.mark.parametrize(("double", "most"), [(False, 1e-5), (True, 1e-12)])
def test_white_furnace_by_sampling_has_no_variance(double, most):
    for case in cases(100):
        mean, spread = by_sampling(case, double)
        assert mean == pytest.approx(1, abs=1e-3), case
        assert spread < most, case


@pytest.mark.slow
@pytest.mark.parametrize(("double", "most"), [(False, 1e-3), (True, 1e-7)])
def test_white_furnace_by_evaluation_all_over_the_range(double, most):
    for case in cases(600, seed=1):
        assert by_evaluation(case, double) == pytest.approx(1, abs=most), case


def test_along_the_fibre_itself_all_light_is_reflected():
    case = Case(beta_m=0.1)
    vector = array_types(False)[1]
    for pole in (1.0, -1.0):
        known = lobes.known(fibre(case, False), vector(0, pole, 0))
        assert np.array(known.attenuation[0]) == pytest.approx(1)
        wo = lobes.sample_lobe(known, 0, *uniforms(1000, 0, False))
        assert dr.all(wo.y * pole < -0.5)
        value, pdf = lobes.evaluate_known(known, wo)
        assert np.array(value.x) == pytest.approx(np.array(pdf), rel=1e-5)
        assert np.isfinite(np.array(pdf)).all()


def test_float32_differs_from_float64_only_by_the_rounding_of_an_azimuth():
    """The finest azimuthal lobe is some hundred float32 steps of pi wide: values by eye, not bias.

    A direction's azimuth is a float32 near pi, 2.4e-7 apart; the logistic's scale at
    beta_n = 0.001 is 1.7e-4, so a value there may be off by a few thousandths, and less above.
    """
    rng = np.random.default_rng(0)
    for beta, most in ((0.001, 1e-2), (0.003, 3e-3), (0.01, 1e-3), (0.1, 1e-4), (1.0, 1e-5)):
        case = Case(beta_m=beta, beta_n=beta, theta_deg=40, h=0.6, tilt_deg=2)
        u = [rng.random(5000) for _ in range(3)]
        known = [lobes.known(fibre(case, d), known_direction(case, d)) for d in (False, True)]
        wo = lobes.sample_lobe(known[1], 1, *(array_types(True)[0](x) for x in u))
        rounded = np.array(wo).astype(np.float32)
        single, _ = lobes.evaluate_known(known[0], known[0].direction(rounded))
        double, _ = lobes.evaluate_known(known[1], known[1].direction(rounded.astype(float)))
        error = np.abs(np.array(single.x) / np.array(double.x) - 1)
        assert np.quantile(error, 0.99) < most, beta
