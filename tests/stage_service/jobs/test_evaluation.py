"""A fitted appearance beside the true one."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from appearance import Exposure, HairAppearance, HeldOut
from appearance.bsdf.maps import HairMaps
from appearance.sun_fit.fitted_appearance import FittedAppearance
from reconstruction import Model
from stage_service.jobs.evaluation import evaluate_appearance


def test_one_colour_under_two_azimuthal_roughnesses_is_one_colour(tmp_path):
    # Chiang et al. 2016, Eq. 9: absorption of a colour grows as the square of 1 / this number.
    def chiang(beta: float) -> float:
        return (
            float(5.969 - 0.215 * beta + 2.532 * beta**2 - 10.73 * beta**3 + 5.574 * beta**4)
            + 0.245 * beta**5
        )

    ours = HairAppearance((0.1, 0.2, 0.4), 0.5, 0.2)
    factor = (chiang(0.2) / chiang(0.6)) ** 2
    true = HairAppearance(tuple(factor * s for s in ours.sigma_a), 0.3, 0.6)
    sun = FittedAppearance(
        ours, (0.5,) * 3, (0.4, 0.3, 0.2), Exposure(1.0), 0.2, 0.2, 0.2, HeldOut()
    )
    sun.save(Model(tmp_path))
    truth = tmp_path / "truth.json"
    truth.write_text(json.dumps({"hair": true.to_dict(), "skin": [0.5, 0.4, 0.3]}))
    figures = evaluate_appearance(Model(tmp_path), truth)
    assert figures["fitted"]["colour"] == pytest.approx(figures["true"]["colour"], rel=1e-6)
    assert (figures["fitted"]["beta_m"], figures["true"]["beta_m"]) == (0.5, 0.3)
    assert figures["fitted"]["skin"] == [0.4, 0.3, 0.2]
    assert figures["true"]["v"] < figures["fitted"]["v"]


def test_the_spread_is_that_of_suns_fit_when_inverse_rendering_is_shown(tmp_path):
    hair = HairAppearance((0.1, 0.2, 0.4), 0.34, 0.2)
    fit = (hair, (0.5,) * 3, (0.4, 0.3, 0.2), Exposure(1.0), 0.2, 0.2, 0.2, HeldOut())
    FittedAppearance(*fit, 0.1, (0.3, 0.4), (0.1, None, 0.2)).save(Model(tmp_path))
    HairMaps.of(replace(hair, beta_m=0.4)).save(Model(tmp_path), np.zeros((1, 2)))
    truth = tmp_path / "truth.json"
    true = HairAppearance((0.1, 0.2, 0.4), 0.28, 0.2)
    truth.write_text(json.dumps({"hair": true.to_dict(), "skin": [0.5, 0.4, 0.3]}))
    figures = evaluate_appearance(Model(tmp_path), truth)
    assert [figures[fit]["beta_m"] for fit in ("fitted", "sun_fit", "true")] == [0.4, 0.34, 0.28]
    assert figures["sun_fit"]["beta_m_interval"] == [0.3, 0.4]
    assert "beta_m_interval" not in figures["fitted"]
    assert figures["sun_fit"]["sigma_a_error"] == [0.1, None, 0.2]
