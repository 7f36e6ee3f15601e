"""Held-out frames beside what a fit makes of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from appearance import Exposure
from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering.held_out import Judged, judge
from appearance.render.tracing import Sampling
from reconstruction import Model, Rig

SAMPLING = Sampling(64, 6)


@pytest.fixture
def judged(plain, tufted, tmp_path):
    """`judged(frame)`: what `judge` says of the tuft's true hair beside one captured frame."""
    rig = Rig("tuft", tuple(o.camera for o in plain.views), plain.lights)
    truth = Judged(tufted.mapped.with_maps(HairMaps.of(tufted.truth)), rig)
    model = Model(tmp_path / "model").create()

    def of(frame):
        return judge(model, [frame], {"truth": truth}, Exposure(plain.scale), SAMPLING)

    return of


def test_saturated_pixels_of_a_held_out_frame_say_nothing(plain, judged):
    """Whether they read what is there, or a tenth of it."""
    whole = plain.views[0].under(np.array([0]))
    bright = whole.radiance.max(axis=-1) > np.quantile(whole.radiance.max(axis=-1), 2 / 3)
    cut = np.where(bright[..., None], 0.1 * whole.radiance, whole.radiance)
    of_rest = judged(replace(whole, valid=~bright))
    assert judged(replace(whole, radiance=cut, valid=~bright)) == of_rest
    assert of_rest != judged(whole)


def test_a_frame_that_is_saturated_everywhere_is_left_out(plain, judged):
    one = plain.views[0].under(np.array([0]))
    assert judged(replace(one, valid=np.zeros_like(one.valid))) == {}
