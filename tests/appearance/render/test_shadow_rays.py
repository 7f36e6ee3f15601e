"""Shadow rays that are spared: what remains counts for them, and never for more than it can."""

from types import SimpleNamespace

import numpy as np
import pytest

from appearance.scene.backend import ensure_backend

ensure_backend()

import mitsuba as mi  # noqa: E402

from appearance.render.paths import PointSource, light_from  # noqa: E402


def arriving(brought: tuple[float, float, float], chance: float, dim: float = 1.0):
    """Value and arrival of a light that no one shades and that brings `brought`."""
    si = SimpleNamespace(
        p=mi.Point3f(0, 0, 0), to_local=lambda v: mi.Vector3f(v), spawn_ray_to=lambda t: None
    )
    scene = SimpleNamespace(occluded=lambda ray, active: mi.Bool(False))
    source = PointSource(mi.Point3f(0, 0, 1), mi.Color3f(1), mi.Float(dim))
    value, lit = light_from(
        scene, si, lambda wo, active: mi.Color3f(*brought), source, mi.Float(chance), mi.Bool(True)
    )
    return np.array(value).ravel(), bool(np.array(lit).all())


def test_dim_light_arrives_seldom_and_then_as_much():
    value, lit = arriving((0.01, 0.005, 0.0), chance=0.005)
    assert lit
    np.testing.assert_allclose(value, [1.0, 0.5, 0.0], rtol=1e-5)
    assert not arriving((0.01, 0.005, 0.0), chance=0.02)[1]
    value, lit = arriving((2.0, 1.0, 0.0), chance=0.999)
    assert lit
    np.testing.assert_allclose(value, [2.0, 1.0, 0.0], rtol=1e-5)


@pytest.mark.parametrize("brightest", [0.0, 1e-44, 1e-39, 1e-30])
def test_next_to_no_light_does_not_arrive_even_by_the_smallest_chance(brightest: float):
    """One random number in eight million is 0, and 0 · ∞ is not a number."""
    assert not arriving((brightest, 0.0, 0.0), chance=0.0)[1]


def test_a_chance_of_zero_counts_as_the_dimmest_light():
    value, lit = arriving((1e-8, 0.0, 5e-9), chance=0.0)
    assert lit
    np.testing.assert_allclose(value, [1.0, 0.0, 0.5], rtol=1e-5)
