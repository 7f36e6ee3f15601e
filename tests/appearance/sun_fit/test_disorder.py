"""How far single hairs turn, by pixels beside each other: on lobes that are computed."""

import numpy as np
import pytest

from appearance.bsdf.longitudinal import longitudinal, variance_of_roughness
from appearance.observations import Observed
from appearance.sun_fit.disorder import (
    Likeness,
    PixelPairs,
    beside,
    direct_share,
    disordered,
    match_disorder,
)
from appearance.sun_fit.hair_parts import SIDE
from appearance.sun_fit.highlights import Highlight
from appearance.sun_fit.mirror_samples import answers, lobes
from appearance.sun_fit.visible_fibres import VisibleFibres
from reconstruction import Camera, Light, Strands
from reconstruction.geometry.lights import dome_positions

CAMERA = Camera.look_at("cam", 48, 48, (0, -1, 0), (0, 0, 0), 4)
PIXELS = np.arange(48 * 48)
LIGHTS = tuple(
    Light(f"l{k}", p, np.full(3, 1.0)) for k, p in enumerate(dome_positions(60, 1.0, -80.0))
)
WHOLE = np.ones((1, SIDE**2))


def fibres(lean):
    """Upright fibres across the camera's axis, each pixel's turned by `lean (P, K)` radians."""
    tangent = np.stack([0 * lean, np.sin(lean), np.cos(lean)], axis=-1)
    return VisibleFibres(0 * tangent, tangent, np.ones(lean.shape, bool))


def leaning(degrees, seed, drift_deg=0.0):
    """Two hairs a pixel, each turned at random; `drift_deg` from one pixel to the next in a row."""
    rng = np.random.default_rng(seed)
    turn = np.radians(degrees) * rng.normal(size=(len(PIXELS), 2))
    return turn + np.radians(drift_deg) * (PIXELS % 48 - 24)[:, None]


def likeness(hair, strands, noise=0.0, floor=0.0, beta=0.28, seed=0):
    """That of the answers of `hair`, whose directions `strands` are taken to be."""
    shape = (len(LIGHTS), len(PIXELS))
    seen = Observed(CAMERA, LIGHTS, PIXELS, np.zeros((*shape, 3)), np.ones(shape, bool))
    pairs = PixelPairs.of(seen, strands, 0.0)
    v = float(variance_of_roughness(beta))
    value = lobes(seen, hair, v, 0.0, pairs.at).mean(axis=0) + floor * float(longitudinal(0, 0, v))
    rng = np.random.default_rng(seed)
    value = value * (1 + noise * rng.normal(size=value.shape))
    return pairs.likeness(value, value)


@pytest.fixture(scope="module")
def turned():
    straight = fibres(np.zeros((len(PIXELS), 2)))
    return [
        (d, likeness(fibres(leaning(d, 7 + k)), straight)) for k, d in enumerate((0, 8, 16, 24))
    ]


@pytest.mark.parametrize("turn_deg", [0, 9, 20])
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_pixels_beside_each_other_tell_how_far_hairs_turn(turned, turn_deg, noise):
    straight = fibres(np.zeros((len(PIXELS), 2)))
    captured = likeness(fibres(leaning(turn_deg, 4)), straight, noise, seed=1)
    found = match_disorder(captured, turned)
    assert found.degrees == pytest.approx(turn_deg, abs=2)
    assert found.low - 0.5 <= turn_deg <= found.high + 0.5
    assert found.high - found.low < 6
    assert turn_deg == 9 or found.told == (turn_deg > 9)


def test_how_the_hairs_direction_changes_is_no_disorder(turned):
    """Over the view, by 5° a pixel: 10 and 20 between the pixels that are compared."""
    drifting = leaning(0, 4, drift_deg=5.0)
    captured = likeness(fibres(drifting), fibres(drifting))
    own, _, far = (captured.products / np.maximum(captured.pairs, 1)).sum(axis=0)
    off = own - own.mean()
    assert (off * far).sum() < 0.9 * (off * own).sum()  # pixels four apart are unlike
    assert match_disorder(captured, turned).degrees < 7


@pytest.mark.parametrize(("hair_deg", "alike"), [(0, True), (25, False)])
def test_what_strands_are_off_from_pixel_to_pixel_is_not_the_hairs(hair_deg, alike):
    """Pixels whose hair runs one way answer alike, though strands there are 12° off at random."""
    found = likeness(fibres(leaning(hair_deg, 0)), fibres(leaning(12, 1)[:, :1]))
    assert (found.of(WHOLE)[0] > 0.9) == alike


def test_alike_are_pixels_of_one_highlight_and_not_those_of_strangers():
    straight = fibres(np.zeros((len(PIXELS), 2)))
    assert likeness(straight, straight).of(WHOLE) == pytest.approx(1, abs=0.02)
    strangers = likeness(fibres(np.repeat(leaning(60, 3)[:, :1], 2, axis=1)), straight, beta=0.1)
    assert abs(strangers.of(WHOLE)) < 0.15


def test_paler_hair_in_one_pixel_is_not_unlike():
    straight = fibres(np.zeros((len(PIXELS), 2)))
    shape = (len(LIGHTS), len(PIXELS))
    shade = np.random.default_rng(0).uniform(0.3, 1, len(PIXELS))
    radiance = np.repeat((np.ones(shape) * shade)[..., None], 3, axis=-1)
    seen = Observed(CAMERA, LIGHTS, PIXELS, radiance, np.ones(shape, bool))
    pairs = PixelPairs.of(seen, straight, 0.0)
    value = lobes(seen, straight, 0.07, 0.0, pairs.at).mean(axis=0)
    value = value * answers(seen, straight, 0, pairs.at)
    assert pairs.likeness(value, value).of(WHOLE) == pytest.approx(1, abs=0.02)


def test_light_between_fibres_leaves_a_share_of_what_pixels_are_unlike(turned):
    """Twice the product over all bins, of as much difference: half of the unlikeness."""

    def highlight(gain):
        products = gain * np.linspace(1, 0, 10)[None] + 0.2
        none = np.zeros((1, 30))
        return Highlight(products, np.ones((1, 10)), none, none)

    assert direct_share(highlight(1.0), highlight(2.0)) == pytest.approx(0.5)
    straight = fibres(np.zeros((len(PIXELS), 2)))
    whole = likeness(fibres(leaning(16, 4)), straight)
    products = whole.products.copy()
    products += whole.products[:, :1] / np.maximum(whole.pairs[:, :1], 1) * whole.pairs
    found = match_disorder(Likeness(products, whole.pairs), turned, 0.5)
    assert found.degrees == pytest.approx(match_disorder(whole, turned).degrees, abs=0.5)


def test_turns_that_hardly_show_are_not_told_from_none(turned):
    straight = fibres(np.zeros((len(PIXELS), 2)))
    for seed in range(12):
        captured = likeness(fibres(leaning(4, 100 + seed)), straight, 0.1, seed=seed)
        found = match_disorder(captured, turned)
        assert found.low == 0
        assert 1.5 < found.degrees < found.high == pytest.approx(4, abs=0.6)


def test_a_disorder_beyond_what_was_tried_is_not_told_as_exact(turned):
    straight = fibres(np.zeros((len(PIXELS), 2)))
    found = match_disorder(likeness(fibres(leaning(32, 5)), straight), turned)
    assert found.beyond
    assert found.low > 20
    assert not match_disorder(turned[-1][1], turned).beyond


def test_where_nothing_tells_there_is_no_answer(turned):
    captured = likeness(fibres(leaning(10, 4)), fibres(leaning(0, 4)))
    backwards = [(d, h) for (_, h), d in zip(turned[::-1], (0, 8, 16, 24), strict=True)]
    assert match_disorder(captured, backwards) is None
    assert match_disorder(Likeness(captured.products, 0 * captured.pairs), []) is None
    assert match_disorder(Likeness.joined([]), []) is None


def test_what_lies_beside_a_pixel():
    """In rows of ten: 8 would be beyond the row's end, and 26 is where 27 has none."""
    camera = Camera.look_at("cam", 10, 10, (0, -1, 0), (0, 0, 0), 10)
    pixels = np.array([40, 8, 10, 4, 48, 26, 6])
    seen = Observed(camera, (), pixels, np.zeros((0, 7, 3)), np.zeros((0, 7), bool))
    assert sorted(map(tuple, pixels[beside(seen, 2)].tolist())) == [(4, 6), (6, 8), (6, 26)]
    assert sorted(map(tuple, pixels[beside(seen, 4)].tolist())) == [(4, 8), (8, 48)]


@pytest.mark.parametrize("degrees", [6, 12, 24])
def test_disordered_strands_turn_by_as_much_and_keep_their_roots(degrees):
    z = np.linspace(0, -0.3, 150)
    lines = [np.stack([0.002 * k + 0 * z, 0 * z, z], axis=1) for k in range(200)]
    straight = Strands.from_list(lines)
    waved = disordered(straight, np.radians(degrees), seed=3)
    cosine = (straight.tangents() * waved.tangents()).sum(axis=1)
    turn = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    assert np.sqrt((turn**2).mean()) == pytest.approx(degrees, rel=0.1)
    roots = waved.offsets[:-1]
    np.testing.assert_allclose(waved.points[roots], straight.points[roots], atol=1e-6)
