"""Stiff and extreme cases: the fit ends by itself, and nearer to the truth than it began."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from appearance import HairAppearance, InverseRenderingOptions
from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering.loop import run
from appearance.inverse_rendering.options import Effort
from appearance.inverse_rendering.problem import FitProblem
from appearance.metrics.decision import MATERIAL, Material

START = HairAppearance((0.2, 0.2, 0.2), 0.3, 0.3)
FEW = Effort(pixels=40, spp=4, max_depth=5)
OPTIONS = InverseRenderingOptions(effort=FEW)
ENOUGH = replace(OPTIONS, effort=Effort(pixels=80, spp=16, max_depth=5))


def check(
    problem: FitProblem,
    start: HairMaps,
    options: InverseRenderingOptions = OPTIONS,
    stages: tuple[Material, ...] = ("shared",),
) -> HairMaps:
    found = run(problem, start, stages=stages, options=options)
    assert "shared" in found.kept
    assert np.isfinite(found.maps.sigma_a).all()
    return found.maps


def off(maps: HairMaps, truth: HairAppearance) -> float:
    """The largest |log| of a found number over its true one: absorption, beta_m."""
    found = [*maps.sigma_a.reshape(-1, 3).mean(0), maps.beta_m]
    return float(np.abs(np.log(np.array(found) / [*truth.sigma_a, truth.beta_m])).max())


@pytest.mark.slow
def test_black_hair_is_found_darker_than_the_start(tufted):
    truth = HairAppearance((6.0, 9.0, 15.0), 0.25, 0.3)
    found = check(tufted.problem(HairMaps.of(truth), views=1), HairMaps.of(START))
    assert found.sigma_a.min() > 1.3 * START.sigma_a[0]


@pytest.mark.slow
def test_white_hair_is_found_lighter_than_the_start(tufted):
    truth = HairAppearance((0.001, 0.002, 0.008), 0.25, 0.3)
    # light goes far in it: of few paths, one bright one decides whether the fit is taken
    quiet = replace(ENOUGH, effort=replace(ENOUGH.effort, spp=256))
    found = check(tufted.problem(HairMaps.of(truth), views=1), HairMaps.of(START), quiet)
    assert found.sigma_a.max() < 0.7 * START.sigma_a[0]


@pytest.mark.slow
@pytest.mark.parametrize("beta_m", [0.02, 0.9])
def test_a_roughness_that_starts_at_either_end(plain, tufted, beta_m):
    found = check(plain, HairMaps.of(replace(START, beta_m=beta_m)), ENOUGH)
    assert off(found, tufted.truth) < 0.75


@pytest.mark.slow
def test_four_lights_and_one_view(tufted):
    lone = tufted.problem(views=1, lights=tufted.dome(8)[:4], spp=1024)
    quiet = replace(ENOUGH, effort=replace(ENOUGH.effort, spp=64))
    found = check(lone, HairMaps.of(START), quiet)
    assert (np.diff(found.sigma_a[0, 0, 0]) > 0).all(), "brown hair takes most of the blue"


def test_a_saturated_highlight_is_left_out_and_changes_nothing_else(plain, tufted):
    views = []
    for o in plain.views:
        bright = o.radiance.max(axis=-1) > np.percentile(o.radiance, 95)
        radiance = np.where(bright[..., None], 1e9, o.radiance).astype(np.float32)
        views.append(replace(o, radiance=radiance, valid=~bright))
    cut = FitProblem(plain.mapped, views, plain.scale, plain.skin)
    quiet = replace(ENOUGH, effort=replace(ENOUGH.effort, spp=64, pixels=160))
    assert off(check(cut, HairMaps.of(START), quiet), tufted.truth) < 0.4


@pytest.mark.slow
def test_lights_at_a_third_of_the_distance(tufted):
    near = tufted.problem(views=1, lights=tufted.dome(8, 0.33))
    quiet = replace(ENOUGH, effort=replace(ENOUGH.effort, spp=32))
    found = check(near, HairMaps.of(START), replace(quiet, shape=(2, 2, 2)), MATERIAL)
    assert off(found, tufted.truth) < 0.75


@pytest.mark.slow
def test_a_bright_constant_image_makes_the_hair_lighter(plain):
    views = [replace(o, radiance=np.full_like(o.radiance, 0.5 / plain.scale)) for o in plain.views]
    grey = FitProblem(plain.mapped, views, plain.scale, plain.skin)
    assert check(grey, HairMaps.of(START), ENOUGH).sigma_a.max() < START.sigma_a[0]


def test_frames_that_are_all_saturated_end_the_fit_at_once_with_the_reason(plain):
    views = [
        replace(o, radiance=np.full_like(o.radiance, 4.0), valid=np.zeros_like(o.valid))
        for o in plain.views
    ]
    start = HairMaps.of(START)
    found = run(FitProblem(plain.mapped, views, 1.0, plain.skin), start, options=OPTIONS)
    assert not found.kept
    assert {x.skipped for x in found.decisions} == {"no pair of camera and light shows lit hair"}
    np.testing.assert_allclose(found.maps.sigma_a, start.sigma_a, rtol=1e-6)


def test_black_frames_end_the_fit_at_once_with_the_reason(plain):
    views = [replace(o, radiance=np.zeros_like(o.radiance)) for o in plain.views]
    start = HairMaps.of(START)
    found = run(FitProblem(plain.mapped, views, 1.0, plain.skin), start, options=OPTIONS)
    assert not found.kept
    assert {x.skipped for x in found.decisions} == {"no pair of camera and light shows lit hair"}
    np.testing.assert_allclose(found.maps.sigma_a, start.sigma_a, rtol=1e-6)
