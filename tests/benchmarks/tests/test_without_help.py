"""What a user has in the place of the truth: a rig that props calibrate, no head."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks.light_planes.without_help import calibrated, copied, rig_errors
from numpy.testing import assert_allclose
from shooting import shoot

from reconstruction import Capture, Rig, Step
from simulators.subject.props import PropResponder, SphereProp


@pytest.mark.slow
def test_props_calibrate_a_stage_to_a_fraction_of_what_is_documented(true_rig: Rig) -> None:
    off = rig_errors(calibrated(true_rig), true_rig)
    assert off["cameras: reprojection_px"] < 0.024
    assert off["cameras: centre_mm"] < 1.2
    assert off["projectors: plane_mm"] < 0.06
    assert off["lights: position"] < 0.002


def test_a_copy_has_another_rig_and_no_head_and_leaves_the_capture_alone(
    true_rig: Rig, nominal_rig: Rig, tmp_path: Path
) -> None:
    responder = PropResponder(true_rig, SphereProp(np.zeros(3), 0.05, 0.8), samples=1)
    capture = shoot(tmp_path / "shot", true_rig, responder, [Step(0, "all_on", 0.02, 0.1)])
    head = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n"
    (capture.path / "head.obj").write_text(head)
    copy = copied(capture, tmp_path / "copy", rig=nominal_rig, head=False)
    assert copy.head is None
    assert_allclose(copy.rig.cameras[0].K, nominal_rig.cameras[0].K)
    assert_allclose(copy.frame(copy.steps[0], "cam_0"), capture.frame(capture.steps[0], "cam_0"))
    again = Capture(capture.path)
    assert again.head is not None
    assert_allclose(again.rig.cameras[0].K, true_rig.cameras[0].K)
