"""The fit converges, resumes, and keeps a stage only if held-out frames are better with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from appearance import HairAppearance, InverseRenderingOptions
from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering import loop
from appearance.inverse_rendering.loop import Monitor, run
from appearance.inverse_rendering.unknowns import encode

START = HairMaps.of(HairAppearance((0.2, 0.2, 0.2), 0.4, 0.35))


@pytest.fixture
def options(tufted):
    return InverseRenderingOptions(shape=(2, 2, 2), effort=tufted.quick)


def far(maps: HairMaps, truth: HairAppearance) -> float:
    """The largest |log| of a fitted number over its true one: absorption, beta_m."""
    found = [*maps.sigma_a.reshape(-1, 3).mean(0), maps.beta_m]
    return float(np.abs(np.log(np.array(found) / [*truth.sigma_a, truth.beta_m])).max())


def test_one_colour_and_roughness_are_found_from_pictures(plain, tufted, options):
    reported = []
    monitor = Monitor(lambda what, share: reported.append((what, share)))
    found = run(plain, START, stages=("shared",), options=options, monitor=monitor)
    (decision,) = found.decisions
    assert decision.kept
    assert decision.after < 0.75 * decision.before
    assert far(found.maps, tufted.truth) < 0.4 < far(START, tufted.truth)
    assert reported[-1][0].startswith("shared: error on held-out frames 0.")
    assert [share for _, share in reported] == sorted(share for _, share in reported)


@pytest.mark.slow
def test_fibres_of_straight_hair_are_not_turned_and_lights_stay(plain, tufted, options):
    """Of the truth's one colour, under lights as calibrated."""
    found = run(plain, START, options=options)
    assert [x.stage for x in found.decisions] == ["shared", "spatial", "correctives", "lights"]
    assert "shared" in found.kept
    assert far(found.maps, tufted.truth) < 0.4
    assert np.abs(found.maps.rotation).max() < 0.1
    assert found.gain == pytest.approx(np.ones(8), abs=0.05)


@pytest.mark.slow
def test_maps_are_kept_where_the_hair_has_two_colours(tufted, options):
    sigma_a = np.full((1, 2, 1, 3), 0.06)
    sigma_a[0, 1] = 1.5
    truth = HairMaps(sigma_a, np.zeros((1, 2, 1, 2)), 0.25, 0.35)
    found = run(tufted.problem(truth), START, stages=("shared", "spatial"), options=options)
    assert "spatial" in found.kept
    light, dark = found.maps.sigma_a[..., 0].mean((0, 2))
    assert dark > 3 * light


@pytest.mark.parametrize("varies", [False, True])
def test_lights_refit_absorption_that_varies_and_no_other(plain, options, monkeypatch, varies):
    """Cells of one absorption are there after the correctives, too."""
    maps, calls = START.resized((2, 2, 2)), []
    maps.sigma_a[0] *= 1 + varies
    fit = loop._Fit(plain, options, 2, 0)
    monkeypatch.setattr(loop, "without_axis", lambda light: False)
    monkeypatch.setattr(fit, "_shared", lambda raw, gain, *_: (raw, gain, {}))
    monkeypatch.setattr(loop, "absorption_of_cells", lambda *_, **__: calls.append(1) or maps)
    fit._lights(encode(maps), np.ones(8), lambda *_: None)
    assert len(calls) == varies


@pytest.mark.slow
@pytest.mark.parametrize("killed_in", ["absorption_of_cells", "solve_correctives"])
def test_an_interrupted_fit_does_not_begin_again(plain, options, tmp_path, monkeypatch, killed_in):
    stages = ("shared", "spatial", "correctives")
    whole = run(plain, START, stages=stages, options=options, seed=1)
    monitor, before = Monitor(checkpoint=tmp_path / "fit.npz"), loop.solve_global_parameters

    def killed(*given, **how):
        raise KeyboardInterrupt

    def not_from_the_start(problem, raw, *args):
        assert killed_in == "absorption_of_cells", "solved before it was killed"
        assert raw["beta_m"] != encode(START)["beta_m"]
        return before(problem, raw, *args)

    with monkeypatch.context() as patch:
        patch.setattr(loop, killed_in, killed)
        with pytest.raises(KeyboardInterrupt):
            run(plain, START, stages=stages, options=options, seed=1, monitor=monitor)
    monkeypatch.setattr(loop, "solve_global_parameters", not_from_the_start)
    resumed = run(plain, START, stages=stages, options=options, seed=1, monitor=monitor)
    assert resumed.maps.sigma_a == pytest.approx(whole.maps.sigma_a, rel=1e-3)
    assert resumed.maps.rotation == pytest.approx(whole.maps.rotation, abs=1e-3)
    assert resumed.left_open == pytest.approx(whole.left_open, rel=1e-3)
    assert resumed.kept == whole.kept


@pytest.mark.parametrize(
    ("begins", "offered", "kept"),
    [("true", "light", False), ("light", "true", True), ("true", "true", False)],
)
def test_a_stage_that_worsens_held_out_frames_is_dropped(
    plain, tufted, options, monkeypatch, begins, offered, kept
):
    """Whatever the fit's own pixels show."""
    hair = {
        "true": HairMaps.of(tufted.truth),
        "light": HairMaps.of(replace(tufted.truth, sigma_a=(0.03, 0.06, 0.15))),
    }

    def solve(problem, raw, gain, *args):
        return encode(hair[offered]), gain, {}

    monkeypatch.setattr(loop, "solve_global_parameters", solve)
    found = run(plain, hair[begins], stages=("shared",), options=options)
    np.testing.assert_allclose(found.maps.sigma_a[0, 0, 0], tufted.truth.sigma_a, rtol=1e-6)
    assert bool(found.kept) == kept


def test_stages_that_cannot_pay_are_skipped_with_the_reason(plain, options):
    fine = replace(options, shape=(40, 40, 40))
    found = run(plain, START, stages=("spatial", "correctives"), options=fine)
    assert found.maps.shape == (1, 1, 1)
    assert all("too few for 64000 cells" in x.skipped for x in found.decisions)
    lone = plain.part(np.arange(1), np.arange(3))
    found = run(lone, START, stages=("shared",), options=options)
    assert "no frame can be held out" in str(found.decisions[0])
