"""Motion errors of the light-plane benchmark."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.light_planes.motion_errors import PAPER_PIXELS, motion_errors, true_motion

from reconstruction import Capture
from reconstruction.light_planes import Motion


def test_a_shift_across_the_view_is_so_many_pixels(shoot: Callable[..., Capture]) -> None:
    capture = shoot(sweep=False)
    camera = capture.rig.cameras[0]
    capture.rig = replace(capture.rig, cameras=(camera,))
    points = np.random.default_rng(0).normal(0, 0.02, (200, 3))
    true = Motion.none([3, 7])
    across = 1e-3 * camera.R[0]
    off = replace(true, still=False, translations=np.stack([np.zeros(3), across]))
    errors = motion_errors(capture, points, off, true)
    expected = 1e-3 * camera.K[0, 0] / 0.9 * PAPER_PIXELS / camera.width
    assert errors["mm"]["most"] == pytest.approx(1.0)
    assert errors["shift_mm"]["most"] == pytest.approx(1.0)
    assert errors["turn_deg"]["most"] == pytest.approx(0.0)
    assert errors["pixels"]["most"] == pytest.approx(expected, rel=0.1)
    assert motion_errors(capture, points, true, true)["pixels"]["most"] == 0


def test_the_true_motion_is_that_of_each_tracking_pulse(
    shoot: Callable[..., Capture], tmp_path: Path
) -> None:
    capture = shoot()
    steps = [s.index for s in capture.of_kind("tracking")]
    capture.records = {k: replace(r, pulse=100 + r.step) for k, r in capture.records.items()}
    poses = [
        {"pose": k, "rotation": np.eye(3).tolist(), "translation": [k * 1e-3, 0, 0]}
        for k in range(3)
    ]
    (tmp_path / "poses.json").write_text(json.dumps(poses))
    lines = [{"pulse": 100 + s, "pose": k} for k, s in enumerate(steps)]
    (tmp_path / "exposures.jsonl").write_text("\n".join(map(json.dumps, lines)))
    motion = true_motion(capture, tmp_path)
    assert motion.steps.tolist() == steps
    there_and_back = [0, 1, 2, 1, 0, 1, 2, 1]
    expected = [1e-3 * there_and_back[k % 8] for k in range(len(steps))]
    np.testing.assert_allclose(motion.translations[:, 0], expected)
