"""Numbers that all hair shares, found from pictures: near and far, and where nothing tells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from appearance import HairAppearance
from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering.batches import Batch, lit_pairs
from appearance.inverse_rendering.global_parameters import Evidence, solve_global_parameters
from appearance.inverse_rendering.options import Effort
from appearance.inverse_rendering.problem import FitProblem
from appearance.inverse_rendering.unknowns import decode, encode
from reconstruction import Light
from reconstruction.geometry.cameras import facing
from reconstruction.geometry.light_profiles import cosine_lobe

COLOUR = ("sigma_a", "beta_m", "beta_n", "eta")
NEAR = 0.4  # metres, of lights with axes
EFFORT = Effort(pixels=100, spp=64, max_depth=6)


def solve(problem: FitProblem, hair: HairAppearance, names=COLOUR, effort: Effort = EFFORT):
    raw = encode(HairMaps.of(hair))
    pairs = problem.spread(lit_pairs(problem.views, problem.scale), 2, 8)
    found, gain, left_open = solve_global_parameters(
        problem, raw, np.ones(len(problem.lights)), names, Evidence(pairs, effort, 3)
    )
    return raw, found, decode(found), gain, left_open


@pytest.mark.parametrize(
    "start",
    [
        HairAppearance((0.2, 0.2, 0.2), 0.4, 0.2, eta=1.45),
        pytest.param(HairAppearance((0.2, 0.2, 0.2), 0.9, 0.9), marks=pytest.mark.slow),
    ],
    ids=["near", "far"],
)
def test_all_are_found_together(plain, tufted, start):
    _, _, maps, _, left_open = solve(plain, start, effort=replace(EFFORT, pixels=200))
    truth = tufted.truth
    assert maps.beta_m == pytest.approx(truth.beta_m, rel=0.08)
    assert maps.beta_n == pytest.approx(truth.beta_n, rel=0.4)
    assert maps.eta == pytest.approx(truth.eta, abs=0.08)
    np.testing.assert_allclose(maps.sigma_a[0, 0, 0], truth.sigma_a, rtol=0.25)
    assert left_open["sigma_a"] < 0.4, "brown hair's absorption shows"


@pytest.mark.slow
@pytest.mark.parametrize(("beta_m", "beta_n"), [(0.05, 0.3), (0.8, 0.3), (0.7, 0.7)])
def test_smooth_and_rough_fibres(tufted, beta_m, beta_n):
    truth = replace(tufted.truth, beta_m=beta_m, beta_n=beta_n)
    problem = tufted.problem(HairMaps.of(truth), views=1, spp=2048)
    quiet = replace(EFFORT, pixels=100, spp=256)
    _, _, maps, _, _ = solve(problem, HairAppearance((0.2, 0.2, 0.2), 0.3, 0.3), effort=quiet)
    assert maps.beta_m == pytest.approx(beta_m, rel=0.2)
    assert maps.beta_n == pytest.approx(beta_n, rel=0.3)
    np.testing.assert_allclose(maps.sigma_a[0, 0, 0], truth.sigma_a, rtol=0.15)


def test_roughness_of_misplaced_hair_ends_inside_the_range_in_which_it_is_recovered(plain):
    """Each view's pixels are another's: no roughness renders such frames."""
    views = [
        replace(o, radiance=o.radiance[:, np.random.default_rng(0).permutation(len(o.pixels))])
        for o in plain.views
    ]
    problem = FitProblem(plain.mapped, views, plain.scale, plain.skin)
    _, _, maps, _, _ = solve(problem, HairAppearance((0.2, 0.2, 0.2), 0.3, 0.3))
    assert 0.05 <= maps.beta_m <= 0.8
    assert 0.2 <= maps.beta_n <= 0.7


@pytest.mark.slow
def test_white_hair(tufted):
    """What is left of its light after a crossing; the roughness of a lobe that all light makes."""
    truth = replace(tufted.truth, sigma_a=(0.001, 0.002, 0.008))
    problem = tufted.problem(HairMaps.of(truth), views=1, spp=256)
    quiet = replace(EFFORT, pixels=60, spp=4 * EFFORT.spp)
    _, _, maps, _, _ = solve(problem, HairAppearance((0.2, 0.2, 0.2), 0.3, 0.3), effort=quiet)
    left = np.exp(-2 * maps.sigma_a[0, 0, 0])
    assert left == pytest.approx(np.exp(-2 * np.array(truth.sigma_a)), abs=0.04)
    assert maps.beta_m == pytest.approx(truth.beta_m, rel=0.15)


@pytest.mark.parametrize(
    ("begins", "names", "off", "left"),
    [
        pytest.param(0.2, COLOUR, 0.2, 0.04, marks=pytest.mark.slow),
        (3.0, COLOUR, 0.05, 0.01),
        (3.0, COLOUR[:3], 0, 0.01),
    ],
)
def test_black_hair(tufted, begins, names, off, left):
    """Its highlight tells roughness and index. Of its absorption it tells that it is black."""
    truth = replace(tufted.truth, sigma_a=(6.0, 9.0, 15.0))
    problem = tufted.problem(HairMaps.of(truth), views=1, spp=2048)
    quiet = replace(EFFORT, pixels=60, spp=256)
    _, _, maps, _, left_open = solve(problem, HairAppearance((begins,) * 3, 0.4, 0.3), names, quiet)
    assert maps.beta_m == pytest.approx(truth.beta_m, rel=0.1)
    assert maps.eta == pytest.approx(truth.eta, abs=max(off, 1e-6))
    assert np.exp(-2 * maps.sigma_a).max() < left
    assert left_open["sigma_a"] > 0.4


@pytest.mark.slow
def test_intensities_are_found_and_their_mean_is_kept(tufted):
    plain = tufted.problem(spp=2048)
    off = np.exp(0.06 * np.array([1, -1, 1, -1, 1, -1, 1, -1]))
    lights = [replace(x, intensity=x.intensity * f) for x, f in zip(plain.lights, off, strict=True)]
    views = [replace(o, lights=tuple(lights)) for o in plain.views]
    problem = FitProblem(plain.mapped, views, plain.scale, plain.skin)
    many = replace(EFFORT, spp=256)
    _, _, _, gain, _ = solve(problem, tufted.truth, (*COLOUR, "gain"), many)
    assert np.log(gain).mean() == pytest.approx(0, abs=1e-9)
    assert np.std(np.log(gain * off)) < 0.5 * np.std(np.log(off))


def test_lights_that_no_picture_is_of_stay_calibrated(plain, tufted):
    """Half of the lights are in the pairs, one of them 20 % stronger than its calibration."""
    stronger = [replace(o, radiance=o.radiance.copy()) for o in plain.views]
    for o in stronger:
        o.radiance[0] *= 1.2
    problem = FitProblem(plain.mapped, stronger, plain.scale, plain.skin)
    raw = encode(HairMaps.of(tufted.truth))
    pairs = [Batch(view, np.array([0, 2, 4, 6])) for view in (0, 1)]
    _, gain, _ = solve_global_parameters(
        problem, raw, np.ones(8), ("gain",), Evidence(pairs, replace(EFFORT, spp=16))
    )
    assert gain[0] > 1
    assert (gain[1::2] == 1).all()
    assert np.log(gain).mean() == pytest.approx(0, abs=1e-9)


def test_only_what_is_named_moves(plain, tufted):
    raw, found, _, gain, _ = solve(plain, replace(tufted.truth, beta_m=0.3), ("beta_m",))
    assert found["beta_m"] != raw["beta_m"]
    assert all((found[name] == raw[name]).all() for name in raw if name != "beta_m")
    assert (gain == 1).all()


def test_parameters_without_pixels_keep_their_values(plain, tufted):
    views = [replace(o, valid=np.zeros_like(o.valid)) for o in plain.views]
    problem = FitProblem(plain.mapped, views, plain.scale, plain.skin)
    raw = encode(HairMaps.of(tufted.truth))
    pairs = plain.spread(lit_pairs(plain.views, plain.scale), 2, 8)
    found, gain, left_open = solve_global_parameters(
        problem, raw, np.ones(8), COLOUR, Evidence(pairs, replace(EFFORT, spp=8))
    )
    for name, value in raw.items():
        np.testing.assert_allclose(found[name], value, rtol=1e-12)
    assert (gain == 1).all()
    assert left_open == dict.fromkeys(COLOUR, 1.0)


def test_a_frame_that_is_not_a_number_changes_nothing(plain, tufted):
    views = [replace(o, radiance=np.full_like(o.radiance, np.nan)) for o in plain.views]
    problem = FitProblem(plain.mapped, views, plain.scale, plain.skin)
    raw = encode(HairMaps.of(tufted.truth))
    pairs = plain.spread(lit_pairs(plain.views, plain.scale), 2, 8)
    found, _, _ = solve_global_parameters(
        problem, raw, np.ones(8), COLOUR, Evidence(pairs, replace(EFFORT, spp=8))
    )
    assert all((found[name] == raw[name]).all() for name in raw)


def near_lights(tufted) -> tuple[Light, ...]:
    """Eight lights at 40 cm that aim 10 to 50 degrees past the hair, with lobes cos and cos²."""
    rng = np.random.default_rng(4)
    out = []
    for i, light in enumerate(tufted.dome(8, NEAR)):
        ahead = -light.position / NEAR
        aside = np.cross(ahead, rng.normal(size=3))
        angle = np.radians(10 + 40 * i / 7)
        aim = np.cos(angle) * ahead + np.sin(angle) * aside / np.linalg.norm(aside)
        out.append(replace(light, orientation=facing(aim), profile=cosine_lobe(1.0 + i % 2)))
    return tuple(out)


def colour_error(problem: FitProblem, tufted) -> float:
    """Largest relative error of what a fibre transmits, exp(-2 sigma), over the channels."""
    start = HairAppearance((0.2, 0.2, 0.2), tufted.truth.beta_m, tufted.truth.beta_n)
    _, _, maps, _, _ = solve(problem, start, ("sigma_a",), replace(EFFORT, pixels=200))
    found, truth = (
        np.exp(-2 * np.asarray(x)) for x in (maps.sigma_a[0, 0, 0], tufted.truth.sigma_a)
    )
    return float(np.abs(found / truth - 1).max())


@pytest.mark.slow
def test_colours_under_near_lights_with_axes(tufted) -> None:
    problem = tufted.problem(lights=near_lights(tufted))
    alike = [
        replace(o, lights=tuple(replace(x, orientation=None, profile=None) for x in o.lights))
        for o in problem.views
    ]
    isotropic = FitProblem(tufted.mapped, alike, problem.scale, np.full(3, 0.3))
    with_axes, without = colour_error(problem, tufted), colour_error(isotropic, tufted)
    assert with_axes < 0.03
    assert without > 3 * with_axes
