"""A fitted appearance beside the true one."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from appearance import Exposure, HairAppearance, HeldOut
from appearance.bsdf.maps import HairMaps
from appearance.sun_fit.fitted_appearance import FittedAppearance, Uncertainty
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
    known = Uncertainty(0.02, 0.4, 0.6, (0.1, 0.1, 0.1), 12.0, 0.6)
    replace(sun, uncertainty=known).save(Model(tmp_path))
    truth = tmp_path / "truth.json"
    truth.write_text(json.dumps({"hair": true.to_dict(), "skin": [0.5, 0.4, 0.3]}))
    HairMaps.of(replace(ours, beta_m=0.518)).save(Model(tmp_path), np.zeros((1, 2)))
    figures = evaluate_appearance(Model(tmp_path), truth)
    # 12° off: by Chiang's formula what is left of the lobe of 0.518 is that of 0.4
    assert figures["inverse_rendering"]["fibre_beta_m"] == pytest.approx(0.4, abs=2e-3)
    ends = figures["inverse_rendering"]["fibre_beta_m_range"]
    # the lobe's variance 0.353 ± 0.019 (2 % of 0.518), that of 12 ± 0.6° 0.175 ± 0.018
    assert ends == pytest.approx([0.350, 0.442], abs=2e-3)
    replace(sun, uncertainty=replace(known, beta_m=0.1)).save(Model(tmp_path))
    found = evaluate_appearance(Model(tmp_path), truth)["inverse_rendering"]
    assert found["fibre_beta_m_range"] == pytest.approx([0.0, 0.530], abs=2e-3), "0.353 ± 0.098"
    Model(tmp_path).remove("hair_maps.npz")
    figures = evaluate_appearance(Model(tmp_path), truth)
    assert figures["fitted"]["colour"] == pytest.approx(figures["true"]["colour"], rel=1e-6)
    assert (figures["fitted"]["beta_m"], figures["true"]["beta_m"]) == (0.5, 0.3)
    assert figures["fitted"]["skin"] == [0.4, 0.3, 0.2]
    assert figures["true"]["v"] < figures["fitted"]["v"]
