"""The fit converges, resumes, repeats, and never returns less than it was given."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from appearance import HairAppearance, InverseRenderingOptions
from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering import loop
from appearance.inverse_rendering.loop import Monitor, run
from appearance.inverse_rendering.unknowns import LightDeviations
from reconstruction import BadOptions, parse_options, silent

START = HairMaps.of(HairAppearance((0.2, 0.2, 0.2), 0.4, 0.35))


@pytest.fixture
def original(tufted):
    """By steps alone, as variants with more to find end."""
    return InverseRenderingOptions(
        variant="original", steps=50, effort=tufted.quick, gauss_newton=False
    )


def far(maps: HairMaps, truth: HairAppearance) -> float:
    """The largest |log| of a fitted number over its true one: absorption, beta_m."""
    found = [*maps.sigma_a.reshape(-1, 3).mean(0), maps.beta_m]
    return float(np.abs(np.log(np.array(found) / [*truth.sigma_a, truth.beta_m])).max())


def test_one_colour_and_roughness_are_found_from_pictures(plain, tufted, original):
    seen = []
    found = run(
        plain, START, options=original, monitor=Monitor(lambda what, share: seen.append(what))
    )
    assert found.error < 0.5 * found.start_error
    assert far(found.maps, tufted.truth) < 0.4 < far(START, tufted.truth)
    assert "error" in seen[0]
    assert [step for _, step, _ in found.history][:3] == [0, 10, 20]


def test_without_steps_too(plain, tufted, original):
    seen = []
    options = replace(original, gauss_newton=True)
    found = run(
        plain, START, options=options, monitor=Monitor(lambda what, share: seen.append(share))
    )
    assert (found.ended, found.steps) == ("converged", 0)
    assert found.error < 0.5 * found.start_error
    assert far(found.maps, tufted.truth) < 0.4
    assert seen == sorted(seen)


@pytest.mark.slow
def test_a_volume_is_coloured_before_it_gets_correctives(plain, original):
    options = replace(original, gauss_newton=True, variant="correctives", shape=(2, 2, 2))
    seen = []
    found = run(
        plain,
        START,
        options=options,
        monitor=Monitor(snapshot=lambda seconds, maps: seen.append(maps)),
    )
    assert found.steps == 0
    assert found.error < 0.6 * found.start_error
    assert all(maps.shape == (2, 2, 2) for maps in seen)
    coloured = [maps for maps in seen if np.ptp(maps.sigma_a[..., 0]) > 0]
    assert (coloured[0].rotation == 0).all()
    # the fibres are not turned
    assert np.abs(found.maps.rotation).max() < 0.1


def test_a_fit_that_was_interrupted_goes_on_where_it_was(plain, original, tmp_path):
    options = replace(original, steps=11)
    whole = run(plain, START, options=options, seed=1)
    file = tmp_path / "fit.npz"

    def killed(what, share):
        if share > 0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(plain, START, options=options, seed=1, monitor=Monitor(killed, file))
    resumed = run(plain, START, options=options, seed=1, monitor=Monitor(checkpoint=file))
    assert resumed.steps == whole.steps
    # on a GPU a gradient's sums come in any order: no two fits are the same
    near = 0.015 if str(mi.variant()).startswith("cuda") else 1e-3
    np.testing.assert_allclose(resumed.maps.sigma_a, whole.maps.sigma_a, rtol=near)
    assert resumed.maps.beta_m == pytest.approx(whole.maps.beta_m, rel=near)
    other = run(
        plain, START, options=replace(options, steps=1), seed=2, monitor=Monitor(checkpoint=file)
    )
    assert other.steps == 1


@pytest.mark.parametrize(
    ("variant", "left"), [("original", 0), pytest.param("correctives", 1, marks=pytest.mark.slow)]
)
def test_an_interrupted_fit_does_not_begin_again(plain, original, tmp_path, variant, left):
    """Nearly all of its time goes into what comes before the first step, if there is one at all."""
    options = replace(original, gauss_newton=True, variant=variant, shape=(2, 2, 2))
    whole = run(plain, START, options=options, seed=1)
    file, guesses, again = tmp_path / "fit.npz", [], []

    def killed(seconds, maps):
        guesses.append(maps)
        if len(guesses) == len(whole.history) + 1 - left:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(plain, START, options=options, seed=1, monitor=Monitor(silent, file, killed))
    monitor = Monitor(silent, file, lambda seconds, maps: again.append(maps))
    resumed = run(plain, START, options=options, seed=1, monitor=monitor)
    assert len(again) == left + 1
    assert resumed.maps.sigma_a == pytest.approx(whole.maps.sigma_a, rel=1e-3)
    assert resumed.maps.rotation == pytest.approx(whole.maps.rotation, abs=1e-3)
    assert resumed.left_open == pytest.approx(whole.left_open, rel=1e-3)
    assert len(resumed.history) == len(whole.history)


def test_what_comes_again_and_spoils_what_was_found_is_not_taken(
    plain, tufted, original, monkeypatch
):
    options = replace(original, gauss_newton=True, variant="spatial", shape=(2, 2, 2))
    right, calls = loop.absorption_of_cells, []

    def black_later(*given, **how):
        calls.append(how)
        maps = right(*given, **how)
        return maps if len(calls) == 1 else replace(maps, sigma_a=np.full((2, 2, 2, 3), 9.0))

    monkeypatch.setattr(loop, "absorption_of_cells", black_later)
    found = run(plain, START, options=options)
    assert len(calls) == 3
    assert found.error < 0.5 * found.start_error
    assert far(found.maps, tufted.truth) < 0.4


def test_a_fit_from_the_truth_does_not_leave_it_for_noise(plain, tufted, original):
    few = replace(tufted.quick, pixels=20, spp=1, gradient_spp=1)
    found = run(plain, HairMaps.of(tufted.truth), options=replace(original, steps=10, effort=few))
    assert far(found.maps, tufted.truth) < 0.1


@pytest.mark.parametrize(
    ("begins", "offered", "taken"),
    [("true", "light", False), ("light", "true", True), ("true", "true", False)],
)
def test_what_whole_pictures_speak_against_is_not_taken(
    plain, tufted, original, monkeypatch, begins, offered, taken
):
    """Whatever the fit's own pixels say."""
    hair = {
        "true": HairMaps.of(tufted.truth),
        "light": HairMaps.of(replace(tufted.truth, sigma_a=(0.03, 0.06, 0.15))),
    }

    def solve(problem, raw, gain, *args):
        return problem.encode(hair[offered], LightDeviations.calibrated(len(gain))), gain, {}

    monkeypatch.setattr(loop, "solve_global_parameters", solve)
    found = run(plain, hair[begins], options=replace(original, gauss_newton=True))
    np.testing.assert_allclose(found.maps.sigma_a[0, 0, 0], tufted.truth.sigma_a, rtol=1e-6)
    assert (found.refused is None) == taken


@pytest.mark.parametrize(
    ("wrong", "place"),
    [({"variant": "all"}, "variant"), ({"steps": 0}, "steps"), ({"shape": (2, 0, 2)}, "shape.1")],
)
def test_options_that_make_no_sense_are_refused(wrong, place):
    with pytest.raises(BadOptions, match=f"options.{place}"):
        parse_options(InverseRenderingOptions, wrong)
