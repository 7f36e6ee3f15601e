"""Roughness from pairs of lights: on lobes that are computed, whose roughness is known."""

from dataclasses import fields, replace

import numpy as np
import pytest

from appearance.bsdf.longitudinal import longitudinal, variance_of_roughness
from appearance.observations import Observed
from appearance.sun_fit.hair_parts import SIDE
from appearance.sun_fit.highlights import EDGES, WINDOW, Highlight, LightPairs
from appearance.sun_fit.light_correlation import match_roughness
from appearance.sun_fit.mirror_samples import mirror_samples
from appearance.sun_fit.visible_fibres import VisibleFibres
from reconstruction import Camera, Light
from reconstruction.geometry.light_profiles import LightProfile

BETAS = (0.04, 0.08, 0.12, 0.2, 0.3, 0.45, 0.6, 0.95)
PIXELS, LIGHTS, VIEWS = 450, 24, 2


def highlight(beta, shift_deg=0.0, noise=0.0, floor=0.1, seed=0):
    """What two views show of fibres of roughness `beta` whose tangents are off.

    The highlights of pixels lie `shift_deg` RMS away from where the tangents say, on a floor of a
    share of the peak; `noise` is relative to the mean. The lights are the same for every seed.
    """
    rng, other = np.random.default_rng(1), np.random.default_rng(seed + 2)
    deviation = rng.uniform(-WINDOW, WINDOW, (VIEWS, LIGHTS, PIXELS))
    v = float(variance_of_roughness(beta))
    out = []
    for d in deviation:
        shifted = d + np.radians(shift_deg) * other.normal(size=PIXELS)
        value = longitudinal(0.5 * shifted, 0.5 * shifted, v)
        value = value + floor * float(longitudinal(0.0, 0.0, v))
        value = value + noise * value.mean() * other.normal(size=value.shape)
        out.append(pairs(d).highlight(value, value))
    return Highlight.joined(out)


def pairs(deviation):
    """Every pair of lights in every pixel; the pixels are dealt out to the parts in turn."""
    index = np.arange(deviation.size).reshape(deviation.shape)
    one, other = np.triu_indices(LIGHTS, 1)
    first, second = index[one].ravel(), index[other].ravel()
    angle = np.abs(deviation.flat[first] - deviation.flat[second])
    part = np.arange(PIXELS) % SIDE**2
    of_sample = part * 30 + np.minimum(((deviation + WINDOW) / (2 * WINDOW) * 30).astype(int), 29)
    of_pair = part[first % PIXELS] * 10 + np.digitize(angle, EDGES[1:-1])
    return LightPairs(
        index.ravel(), of_sample.ravel(), first, second, of_pair, np.ones(deviation.shape)
    )


@pytest.fixture(scope="module")
def family():
    return [(beta, highlight(beta)) for beta in BETAS]


@pytest.mark.parametrize("beta", [0.1, 0.28, 0.5])
@pytest.mark.parametrize("shift_deg", [0, 10, 20])
@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_tangents_that_are_off_leave_the_roughness(family, beta, shift_deg, noise):
    found = match_roughness(highlight(beta, shift_deg, noise, seed=4), family)
    assert found.beta_m == pytest.approx(beta, rel=0.1)
    assert found.low < beta < found.high
    assert found.tangents_deg == pytest.approx(shift_deg / 2, abs=3)  # a broad lobe hides it


def test_the_tangents_error_is_the_scatter_over_other_draws_of_pixels(family):
    """Twelve draws of the shifts, by lobes that are narrow enough to show them."""
    draws = [match_roughness(highlight(0.2, 20, 0.5, seed=k), family) for k in range(12)]
    scatter = np.std([d.tangents_deg for d in draws], ddof=1)
    error = np.median([d.tangents_error_deg for d in draws])
    assert 0.4 * scatter < error < 2.5 * scatter
    assert abs(np.mean([d.tangents_deg for d in draws]) - 10) < 3 * error


def test_a_profile_alone_would_read_tangents_that_are_off_as_roughness(family):
    """The same lobes without the pairs: what the correlation is there for."""
    profile = [h.profiles(np.ones((1, 2 * SIDE**2)))[0, 0] for _, h in family]
    off = highlight(0.2, 20, seed=4).profiles(np.ones((1, 2 * SIDE**2)))[0, 0]
    nearest = int(np.argmin([((p - off) ** 2).sum() for p in profile]))
    assert BETAS[nearest] > 1.4 * 0.2


def test_an_estimate_at_an_end_of_the_range_is_a_warning(family):
    for beta, end in ((0.02, "0.04"), (0.99, "0.95")):
        found = match_roughness(highlight(beta, 5, 0.3), family)
        assert any("rendered range" in w and end in w for w in found.warnings())


def test_a_flat_response_is_a_warning(family):
    flat = [(beta, highlight(0.3, seed=k)) for k, beta in enumerate(BETAS)]
    found = match_roughness(highlight(0.3, 10, 0.5, seed=4), flat)
    assert found.high > 1.7 * found.low
    assert found.warnings()


def test_noise_without_a_highlight_is_a_warning(family):
    rng = np.random.default_rng(0)
    nothing = highlight(0.3)
    values = replace(
        nothing,
        products=nothing.pairs * rng.normal(1, 0.02, nothing.pairs.shape),
        values=nothing.samples * rng.normal(1, 0.02, nothing.samples.shape),
    )
    assert match_roughness(values, family).warnings()


def test_views_that_disagree_are_a_warning(family):
    one, other = highlight(0.2), highlight(0.5)
    half = SIDE**2
    mixed = Highlight(
        *(
            np.concatenate([getattr(one, f.name)[:half], getattr(other, f.name)[half:]])
            for f in fields(one)
        )
    )
    found = match_roughness(mixed, family)
    assert found.views == pytest.approx((0.2, 0.5), rel=0.1)
    assert any("Cameras disagree" in w and "0.2, 0.5" in w for w in found.warnings())


def test_too_few_pairs_are_an_error_that_says_what_to_do(family):
    few = highlight(0.3)
    few = replace(few, pairs=few.pairs * 0)
    with pytest.raises(ValueError, match="needs more lights"):
        match_roughness(few, family)


def test_pixels_beside_a_lights_beam_are_skipped():
    """Other hair lights them a little, and the light itself sends nothing to divide by."""
    camera = Camera.look_at("cam", 101, 1, (0, -1, 0), (0, 0, 0), 12)
    x = np.linspace(-0.1, 0.1, 101)
    beam = LightProfile("beam", [0, 360], [0, 3, 4], [[1, 1, 0], [1, 1, 0]])
    aim = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    light = Light("l", (0, -1, 0), np.ones(3), orientation=aim, profile=beam)
    point = np.stack([x, 0 * x, 0 * x], axis=1)[:, None]
    tangent = np.broadcast_to([0.0, 0.0, 1.0], point.shape)
    fibres = VisibleFibres(point, tangent, np.ones((101, 1), bool))
    sent = light.intensity_towards(point[:, 0]) / (1 + x**2)[:, None]
    valid = np.ones((1, 101), bool)
    observed = Observed(camera, (light,), np.arange(101), 0.2 * sent[None] + 1e-3, valid)
    found = mirror_samples(observed, fibres, tilt_deg=0.0, channel=0)
    angle = np.degrees(np.arctan(np.abs(x)))
    assert len(found.value) == (angle < 3.9).sum()
    assert found.value.min() >= 0.2
    assert found.value.max() < 0.2 + 1e-3 / 0.1 * 1.01
