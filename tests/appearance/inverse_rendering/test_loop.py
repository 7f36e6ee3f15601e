"""The fit converges, resumes, repeats, and never returns less than it was given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from appearance import HairAppearance, InverseRenderingOptions
from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering import loop
from appearance.inverse_rendering.loop import Monitor, run
from appearance.inverse_rendering.unknowns import encode
from reconstruction import BadOptions, parse_options

START = HairMaps.of(HairAppearance((0.2, 0.2, 0.2), 0.4, 0.35))


@pytest.fixture
def original(tufted):
    return InverseRenderingOptions(variant="original", effort=tufted.quick)


def far(maps: HairMaps, truth: HairAppearance) -> float:
    """The largest |log| of a fitted number over its true one: absorption, beta_m."""
    found = [*maps.sigma_a.reshape(-1, 3).mean(0), maps.beta_m]
    return float(np.abs(np.log(np.array(found) / [*truth.sigma_a, truth.beta_m])).max())


def test_one_colour_and_roughness_are_found_from_pictures(plain, tufted, original):
    reported = []
    monitor = Monitor(lambda what, share: reported.append((what, share)))
    found = run(plain, START, options=original, monitor=monitor)
    assert found.ended == "converged"
    assert found.error < 0.5 * found.start_error
    assert far(found.maps, tufted.truth) < 0.4 < far(START, tufted.truth)
    assert reported[0][0].startswith("start: error 0.")
    assert [share for _, share in reported] == sorted(share for _, share in reported)


@pytest.mark.slow
def test_a_volume_is_coloured_before_it_gets_correctives(plain, original):
    options = replace(original, variant="correctives", shape=(2, 2, 2))
    found = run(plain, START, options=options)
    assert found.error < 0.6 * found.start_error
    assert found.maps.shape == (2, 2, 2)
    assert np.ptp(found.maps.sigma_a[..., 0]) > 0
    # the fibres are not turned
    assert np.abs(found.maps.rotation).max() < 0.1


@pytest.mark.parametrize(
    ("variant", "killed_in"),
    [
        ("original", "FitProblem.full_image_errors"),
        pytest.param("correctives", "solve_correctives", marks=pytest.mark.slow),
    ],
)
def test_an_interrupted_fit_does_not_begin_again(
    plain, original, tmp_path, monkeypatch, variant, killed_in
):
    options = replace(original, variant=variant, shape=(2, 2, 2))
    whole = run(plain, START, options=options, seed=1)
    monitor, module = Monitor(checkpoint=tmp_path / "fit.npz"), "appearance.inverse_rendering.loop"

    def killed(*given, **how):
        raise KeyboardInterrupt

    def solved_twice(*given, **how):
        raise AssertionError("solved before it was killed")

    with monkeypatch.context() as patch:
        patch.setattr(f"{module}.{killed_in}", killed)
        with pytest.raises(KeyboardInterrupt):
            run(plain, START, options=options, seed=1, monitor=monitor)
    monkeypatch.setattr(f"{module}.solve_global_parameters", solved_twice)
    resumed = run(plain, START, options=options, seed=1, monitor=monitor)
    assert resumed.maps.sigma_a == pytest.approx(whole.maps.sigma_a, rel=1e-3)
    assert resumed.maps.rotation == pytest.approx(whole.maps.rotation, abs=1e-3)
    assert resumed.left_open == pytest.approx(whole.left_open, rel=1e-3)
    assert len(resumed.history) == len(whole.history)


@pytest.mark.slow
def test_a_repeated_step_that_worsens_the_fit_is_rejected(plain, tufted, original, monkeypatch):
    options = replace(original, variant="spatial", shape=(2, 2, 2))
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
    few = replace(tufted.quick, pixels=20, spp=1)
    found = run(plain, HairMaps.of(tufted.truth), options=replace(original, effort=few))
    assert far(found.maps, tufted.truth) < 0.1


@pytest.mark.parametrize(
    ("begins", "offered", "taken"),
    [("true", "light", False), ("light", "true", True), ("true", "true", False)],
)
def test_a_step_that_worsens_full_images_is_rejected(
    plain, tufted, original, monkeypatch, begins, offered, taken
):
    """Whatever the fit's own pixels say."""
    hair = {
        "true": HairMaps.of(tufted.truth),
        "light": HairMaps.of(replace(tufted.truth, sigma_a=(0.03, 0.06, 0.15))),
    }

    def solve(problem, raw, gain, *args):
        return encode(hair[offered]), gain, {}

    monkeypatch.setattr(loop, "solve_global_parameters", solve)
    found = run(plain, hair[begins], options=original)
    np.testing.assert_allclose(found.maps.sigma_a[0, 0, 0], tufted.truth.sigma_a, rtol=1e-6)
    assert (found.rejected is None) == taken


@pytest.mark.parametrize(
    ("wrong", "place"),
    [({"variant": "all"}, "variant"), ({"steps": 9}, "steps"), ({"shape": (2, 0, 2)}, "shape.1")],
)
def test_options_that_make_no_sense_are_refused(wrong, place):
    with pytest.raises(BadOptions, match=f"options.{place}"):
        parse_options(InverseRenderingOptions, wrong)
