"""Roughness from pairs of lights: on lobes that are computed, whose roughness is known."""

from dataclasses import fields, replace

import numpy as np
import pytest

from appearance.bsdf.longitudinal import longitudinal, variance_of_roughness
from appearance.observations import Observed
from appearance.sun_fit.disorder import Disorder
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


def test_the_tangents_error_says_what_other_pixels_would_have_said(family):
    """Twelve other draws of the shifts, by lobes that do not hide them, against one draw's word."""
    draws = [match_roughness(highlight(0.2, 20, 0.5, seed=k), family) for k in range(12)]
    scatter = np.std([d.tangents_deg for d in draws], ddof=1)
    told = np.median([d.tangents_error_deg for d in draws])
    assert 0.4 * scatter < told < 2.5 * scatter
    assert abs(np.mean([d.tangents_deg for d in draws]) - 10) < 3 * told


def test_a_profile_alone_would_read_tangents_that_are_off_as_roughness(family):
    """The same lobes without the pairs: what the correlation is there for."""
    profile = [h.profiles(np.ones((1, 2 * SIDE**2)))[0, 0] for _, h in family]
    off = highlight(0.2, 20, seed=4).profiles(np.ones((1, 2 * SIDE**2)))[0, 0]
    nearest = int(np.argmin([((p - off) ** 2).sum() for p in profile]))
    assert BETAS[nearest] > 1.4 * 0.2


def test_an_answer_at_an_end_of_the_range_is_a_warning(family):
    for beta, end in ((0.02, "0.04"), (0.99, "0.95")):
        found = match_roughness(highlight(beta, 5, 0.3), family)
        assert any("end of the range" in w and end in w for w in found.warnings())


def test_a_highlight_that_does_not_answer_is_a_warning(family):
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
    assert any("views disagree" in w and "0.2, 0.5" in w for w in found.warnings())


def test_too_few_pairs_are_an_error_that_says_what_to_do(family):
    few = highlight(0.3)
    few = replace(few, pairs=few.pairs * 0)
    with pytest.raises(ValueError, match="needs more lights"):
        match_roughness(few, family)


def test_a_disorder_that_is_hardly_known_changes_the_roughness_half_way(family):
    """5 ± 5°: its square, 25 less 25, is as uncertain as it is large."""
    smooth, rough = (match_roughness(highlight(beta), family) for beta in (0.2, 0.3))
    found = smooth.after(rough, Disorder(5, 5, 0, 24))
    assert found.beta_m == pytest.approx((smooth.beta_m * rough.beta_m) ** 0.5)
    assert found.low < 0.2 < found.beta_m < 0.3 < found.high
    sure = smooth.after(rough, Disorder(5, 0.0, 5, 24))
    assert (sure.beta_m, sure.error) == pytest.approx((smooth.beta_m, smooth.error))
    assert smooth.after(rough, Disorder(0, 1.0, 0, 24)).beta_m == pytest.approx(rough.beta_m)


def test_more_disorder_than_was_tried_is_a_warning(family):
    about = match_roughness(highlight(0.3, 20, seed=4), family)
    found = about.after(about, Disorder(24, 5, 22, 24))
    assert any("turned by 24°" in w for w in found.warnings())


def test_turns_that_may_be_there_and_do_not_show_are_in_the_interval(family):
    smooth, rough = (match_roughness(highlight(beta), family) for beta in (0.2, 0.3))
    found = rough.or_less(smooth, Disorder(10, 10, 0, 24))
    assert found.beta_m == rough.beta_m
    assert (found.low, found.high) == (pytest.approx(smooth.beta_m), rough.high)
    assert found.error == pytest.approx(0.5 * np.log(rough.beta_m / smooth.beta_m))
    assert any("up to 20°" in w and "as low as 0.2" in w for w in found.warnings())
    same = rough.or_less(rough, Disorder(0, 3, 0, 24))
    assert (same.low, same.high) == (rough.low, rough.high)
    assert same.error == pytest.approx(rough.error)
    assert same.warnings() == rough.warnings()


def test_a_light_tells_nothing_of_hair_beside_its_beam():
    """There other hair lights it a little: any number, over the nothing that the light sends."""
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
    seen = Observed(camera, (light,), np.arange(101), 0.2 * sent[None] + 1e-3, valid)
    found = mirror_samples(seen, fibres, tilt_deg=0.0, channel=0)
    angle = np.degrees(np.arctan(np.abs(x)))
    assert len(found.value) == (angle < 3.9).sum()
    assert found.value.min() >= 0.2
    assert found.value.max() < 0.2 + 1e-3 / 0.1 * 1.01
