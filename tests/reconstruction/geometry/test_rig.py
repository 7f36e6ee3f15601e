"""Rig geometry: cameras, projectors, lights, and the files that describe them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from reconstruction import Light, Rig
from reconstruction.geometry.rig import RigError

DEMO = Path(__file__).resolve().parents[3] / "stage_service" / "rigs" / "demo.toml"


def test_a_light_whose_rows_are_right_up_forward_is_refused():
    """Its profile would shine upside down: rows are right, down, forward, as of cameras."""
    right, down, forward = np.eye(3)
    Light("spot", (0, 0, 1), (1, 1, 1), orientation=np.array([right, down, forward]))
    with pytest.raises(ValueError, match=r"spot: orientation must be a rotation .* no mirror"):
        Light("spot", (0, 0, 1), (1, 1, 1), orientation=np.array([right, -down, forward]))


def test_the_domes_radius_is_not_that_of_its_lamps(tmp_path):
    for name in ("demo", "stage331"):
        rig = Rig.load(DEMO.with_name(f"{name}.toml"))
        assert {light.radius for light in rig.lights} == {0.0}
    (tmp_path / "rig.toml").write_text(
        "[dome]\nlights = 5\nradius = 1.2\nlight_radius = 0.02\nintensity = [1.0, 1.0, 1.0]\n"
        '[[cameras]]\nname = "c"\nposition = [0, -1, 0]\ntarget = [0, 0, 0]\nfov_deg = 20\n'
        "width = 8\nheight = 8\n"
    )
    lights = Rig.load(tmp_path / "rig.toml").lights
    assert {light.radius for light in lights} == {0.02}
    np.testing.assert_allclose([np.linalg.norm(x.position) for x in lights], 1.2)
    text = (tmp_path / "rig.toml").read_text()
    (tmp_path / "rig.toml").write_text(text.replace("light_radius", "lamp_size"))
    with pytest.raises(RigError, match=r"\[dome\]: unknown fields \['lamp_size'\]"):
        Rig.load(tmp_path / "rig.toml")
