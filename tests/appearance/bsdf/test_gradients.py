"""Gradients by automatic differentiation against central differences, in float64."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from benchmarks.bsdf.integrals import Case, array_types, fibre, known_direction
from scipy.spatial.transform import Rotation

from appearance.bsdf import lobes, reference
from appearance.bsdf.shading_frame import rodrigues

PARAMETERS = ("sigma_a", "beta_m", "beta_n", "eta", "tilt")
INSIDE = [
    Case(0.3, 0.3, 30, 0.4, 1.55, 2.0, 0.3),
    Case(0.05, 0.1, -50, -0.8, 1.3, -3.0, 1.5),
    Case(0.8, 0.7, 10, 0.1, 2.0, 10.0, 0.05),
    Case(0.01, 0.01, 70, 0.95, 1.05, 0.0, 4.0),
]
EDGES = [
    Case(0.001, 0.001, 40, 0.4, 1.55, 2.0, 0.3),
    Case(1.0, 1.0, -40, 0.2, 1.55, 2.0, 0.3),
    Case(0.3, 0.3, 30, 1.0, 1.0001, 10.0, 0.0),
    Case(0.3, 0.3, 89.99, -1.0, 3.0, 0.0, 1e4),
    Case(0.2, 0.3, -89.9, 0.0, 1.0001, -10.0, 0.0),
    Case(0.2, 0.2, 0.0, 0.0, 1.55, 0.0, 0.0),
]


def about_lobes(case: Case, count: int = 60) -> np.ndarray:
    rng = np.random.default_rng(2)
    theta, gamma = reference.inclination(case.wi), reference.azimuth(case.wi)
    inner = reference.refracted_azimuth(theta, gamma, case.eta)
    along, around = [], []
    for p in range(3):
        spread = np.sqrt(reference.variance(p, case.beta_m))
        middle = -reference.tilted(p, theta, case.optics["tilt"])
        along.append(middle + spread * rng.normal(size=count))
        turn = gamma + reference.phi(p, gamma, inner)
        around.append(turn + 2 * reference.logistic_scale(case.beta_n) * rng.normal(size=count))
    return reference.direction(np.concatenate(along), np.concatenate(around))


def value(case: Case, name: str, parameter, wo: np.ndarray):
    """BSDF times cosine where the fibre's `name` is the Dr.Jit number `parameter`."""
    vector = array_types(True)[1]
    varied = vector(parameter) if name == "sigma_a" else parameter
    hair = replace(fibre(case, True), **{name: varied})
    return lobes.evaluate(hair, known_direction(case, True), vector(wo.T))[0].x


def number(x: float):
    """`x` where kernels read it from memory: one kernel for all numbers."""
    return dr.opaque(array_types(True)[0], x)


def forward(function, at: float) -> np.ndarray:
    """Derivative of `function` of one Dr.Jit number, by forward differentiation."""
    x = number(at)
    dr.enable_grad(x)
    y = function(x)
    dr.forward(x)
    return np.array(dr.grad(y))


def differences(function, at: float, step: float, one_sided: bool) -> np.ndarray:
    """The same by fourth-order central differences; forward ones where there is no left side."""
    if one_sided:
        stencil = {0: -25 / 12, 1: 4, 2: -3, 3: 4 / 3, 4: -1 / 4}
    else:
        stencil = {-2: 1 / 12, -1: -2 / 3, 1: 2 / 3, 2: -1 / 12}
    return sum(c * np.array(function(number(at + k * step))) for k, c in stencil.items()) / step


@pytest.mark.parametrize("name", PARAMETERS)
@pytest.mark.parametrize("case", INSIDE + EDGES)
def test_gradients_match_differences(name, case):
    at = case.sigma_a if name == "sigma_a" else case.optics[name]
    wo = about_lobes(case)

    def function(x):
        return value(case, name, x, wo)

    finest = float(reference.logistic_scale(case.beta_n))
    step = {
        "sigma_a": 1e-4 * (1 + at),
        "eta": 1e-3 * min(at - 1, finest),
        "tilt": 1e-4 * case.beta_m,
    }.get(name, 1e-4 * at)
    got = forward(function, at)
    want = differences(function, at, step, one_sided=name == "sigma_a" and at == 0)
    assert np.isfinite(got).all()
    values = np.abs(np.array(function(number(at)))).max()
    rounding = 1e-14 * values / step
    assert np.abs(got - want).max() < 1e-5 * np.abs(want).max() + rounding


@pytest.mark.parametrize("case", INSIDE + EDGES)
def test_float32_gradients_are_finite_and_near_those_of_float64(case):
    wo = about_lobes(case)
    grads = []
    for double in (False, True):
        vector = array_types(double)[1]
        hair = fibre(case, double)
        dr.enable_grad(hair.sigma_a, hair.beta_m, hair.beta_n, hair.eta, hair.tilt)
        total = dr.mean(lobes.evaluate(hair, known_direction(case, double), vector(wo.T))[0].x)
        dr.backward(total)
        named = (hair.sigma_a.x, hair.beta_m, hair.beta_n, hair.eta, hair.tilt)
        grads.append([dr.grad(x)[0] for x in named])
    assert np.isfinite(grads).all()
    assert grads[0] == pytest.approx(grads[1], rel=0.02, abs=0.02 * max(map(abs, grads[1])))


def test_gradients_with_respect_to_the_known_direction_are_finite_at_the_poles():
    for wi in ([0, 1, 0], [0, -1, 0], [1, 0, 0], [-1, 0, 0], [0, 0, 1]):
        vector = array_types(False)[1]
        known = vector(*map(float, wi))
        dr.enable_grad(known)
        got = lobes.evaluate(fibre(INSIDE[0], False), known, vector(0, 0.6, 0.8))[0]
        dr.backward(dr.sum(got))
        assert np.isfinite(np.array(dr.grad(known))).all(), wi


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.0999, 0.1001, 1.0, 3.0])
def test_rodrigues_turns_like_a_rotation_and_is_differentiable_everywhere(angle):
    vector = array_types(True)[1]
    rng = np.random.default_rng(0)
    axis = [0.6 * angle, 0.0, 0.8 * angle]
    v = rng.normal(size=(50, 3))
    want = Rotation.from_rotvec(axis).apply(v)
    turned = np.array(rodrigues(vector(*map(number, axis)), vector(v.T))).T
    assert turned == pytest.approx(want, abs=1e-12)
    for i in range(3):

        def part(x, i=i):
            turned = rodrigues(
                vector(*(x if j == i else number(a) for j, a in enumerate(axis))), vector(v.T)
            )
            return turned.x + 2 * turned.y + 3 * turned.z

        got = forward(part, axis[i])
        assert got == pytest.approx(differences(part, axis[i], 1e-3, False), abs=1e-8)


def test_a_corrective_has_the_gradient_of_the_turned_bsdf():
    vector = array_types(True)[1]
    case, wo = INSIDE[0], about_lobes(INSIDE[0])
    for at in (0.0, 0.05):

        def function(x):
            axis = vector(x, 0, -0.03)
            wi = rodrigues(-axis, known_direction(case, True))
            return lobes.evaluate(fibre(case, True), wi, rodrigues(-axis, vector(wo.T)))[0].x

        got, want = forward(function, at), differences(function, at, 1e-4, False)
        assert np.abs(got - want).max() < 1e-6 * np.abs(want).max()
