"""Roughness from pairs of lights: on lobes that are computed, whose roughness is known."""

from dataclasses import fields, replace

import numpy as np
import pytest

from appearance.bsdf.longitudinal import longitudinal, variance_of_roughness
from appearance.observations import Observed
from appearance.sun_fit.disorder import Disorder, Likeness, match_disorder
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


def turned_hair(turn_deg, beta=0.3, seed=3):
    """What is seen of pixels of two fibres each, which turn by `turn_deg` RMS."""
    rng = np.random.default_rng(1)
    deviation = rng.uniform(-WINDOW, WINDOW, (VIEWS, LIGHTS, PIXELS))
    turns = np.radians(turn_deg) * np.random.default_rng(seed).normal(size=(2, PIXELS))
    v, out = float(variance_of_roughness(beta)), []
    for d in deviation:
        half = [0.5 * d + turn for turn in turns]
        value = np.mean([longitudinal(x, x, v) for x in half], axis=0)
        value = value + 0.1 * float(longitudinal(0.0, 0.0, v))
        out.append(pairs(d).highlight(value, value))
    return Highlight.joined(out)


def surely(degrees):
    return Disorder((degrees**2,) * 100, 24)


@pytest.mark.parametrize(
    ("turn_deg", "rendered_deg", "within"),
    [(4, 8, 0.015), (8, 8, 0.01), (8, 12, 0.08), (12, 8, 0.06)],
)
def test_the_fibres_roughness_is_found_under_turns_that_are_known(
    family, turn_deg, rendered_deg, within
):
    """Where strands were turned by as much for the renderings, and where by more or less."""
    captured = turned_hair(turn_deg)
    rough = match_roughness(captured, family)
    rendered = [(beta, turned_hair(rendered_deg, beta, seed=9)) for beta in BETAS]
    found = rough.of_fibres(match_roughness(captured, rendered), rendered_deg, surely(turn_deg))
    assert found.beta_m == pytest.approx(0.3, rel=within)
    assert abs(found.beta_m - 0.3) < 0.5 * abs(rough.beta_m - 0.3)


def alike(unlike):
    """Pixels of `J` parts of the hair, of which a share `unlike (J,)` answers as strangers do."""
    one = np.tile(np.linspace(1, 0, len(EDGES) - 1), (len(unlike), 1))
    two = one - 0.8 * np.reshape(unlike, (-1, 1)) * (one - one.mean())
    products = np.stack([one, two, two], axis=1)
    return Likeness(1000 * products, np.full(products.shape, 1000.0))


def test_what_is_known_little_better_changes_the_roughness_little(family):
    """From pixels that are alike to such as tell of 21° of turns, surely: no answer jumps."""
    rough, smooth = (match_roughness(highlight(beta), family) for beta in (0.3, 0.15))
    turned = [(d, alike(np.full(SIDE**2, d**2 / 24**2))) for d in (0.0, 12.0, 24.0)]
    scatter = 0.3 * np.random.default_rng(0).normal(size=SIDE**2)
    found = []
    for share in np.linspace(0, 0.8, 33):
        disorder = match_disorder(alike(share + scatter - scatter.mean()), turned)
        found.append((disorder.told, rough.of_fibres(smooth, 24.0, disorder).beta_m))
    told, betas = zip(*found, strict=True)
    assert (told[0], told[-1]) == (False, True)
    assert betas[0] > 0.28
    assert betas[-1] < 0.21
    steps = np.diff(np.log(betas))
    assert steps.max() < 0
    assert steps.min() > 3 * steps.mean()


def test_turns_at_the_end_of_what_was_tried_are_a_warning(family):
    about = match_roughness(highlight(0.3, 20, seed=4), family)
    found = about.of_fibres(about, 24, replace(surely(24), beyond=True))
    assert any("turned by 24°" in w for w in found.warnings())
    assert any("an end of the range" in w for w in found.warnings())
    assert found.warnings() != about.of_fibres(about, 24, surely(24)).warnings()


def test_turns_that_may_be_there_and_do_not_show_are_told(family):
    rough, smooth = (match_roughness(highlight(beta), family) for beta in (0.3, 0.2))
    halves = Disorder((0.0,) * 50 + (400.0,) * 50, 24)
    found = rough.of_fibres(smooth, 20, halves)
    assert found.beta_m == pytest.approx((rough.beta_m * smooth.beta_m) ** 0.5)
    assert found.low < smooth.beta_m * 1.01
    assert found.high > rough.beta_m * 0.99
    assert found.error == pytest.approx(0.5 * np.log(1.5), abs=0.02)
    (warning,) = found.warnings()
    assert "0 to 20°" in warning
    assert "may be 0.2 to 0.3" in warning
    same = rough.of_fibres(smooth, 20, surely(0))
    assert (same.beta_m, same.low, same.high) == pytest.approx(
        (rough.beta_m, rough.low, rough.high)
    )
    assert same.warnings() == rough.warnings()


def test_turns_that_leave_fibres_no_roughness_are_not_believed(family):
    """Of the lobe's variance 20° are 0.045 of 0.085: 48° would be 0.26."""
    rough, smooth = (match_roughness(highlight(beta), family) for beta in (0.3, 0.22))
    found = rough.of_fibres(smooth, 20, Disorder((0.0,) * 60 + (48.0**2,) * 40, 48))
    assert found.beta_m == pytest.approx(0.3, rel=0.02)
    assert found.low > 0.25
    none_left = rough.of_fibres(smooth, 20, surely(48))
    assert none_left.beta_m == pytest.approx(BETAS[0])
    assert any("end of the range" in w for w in none_left.warnings())


def test_turns_that_were_not_measured_may_be_none_or_more_than_the_tangents_say(family):
    rough, smooth = (match_roughness(highlight(beta), family) for beta in (0.3, 0.2))
    found = rough.of_fibres(smooth, 12, None)
    # three quarters of the way in variance is 0.232; a mean of logarithms is less
    assert 0.2 < found.beta_m < 0.232
    assert found.low < 0.17
    assert found.high > 0.29


def test_roughnesses_at_the_ends_of_what_was_rendered_are_told_of_fibres_too(family):
    rough = match_roughness(highlight(0.99, 5, 0.3), family)
    found = rough.of_fibres(replace(rough, beta_m=0.8, low=0.75), 12, surely(4))
    assert any("end of the range" in w for w in found.warnings())


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
