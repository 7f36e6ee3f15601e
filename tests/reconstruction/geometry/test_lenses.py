"""Lens distortion: OpenCV's model, inverted over the image, and never folded back into it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from reconstruction import Camera, Rig
from reconstruction.geometry.rig import RigError

BARREL = (-0.28, 0.11, 1e-3, -7e-4, -0.02)


def camera(distortion=BARREL, **more) -> Camera:
    return Camera.look_at(
        "c", 160, 120, (0.4, -0.9, 0.3), (0, 0.1, 0), 50.0, distortion=distortion, **more
    )


def grid(step=1.0):
    x, y = np.meshgrid(np.arange(-0.5, 159.6, step), np.arange(-0.5, 119.6, step))
    return np.stack([x, y], -1)


@given(
    k=st.tuples(
        st.floats(-0.4, 0.6),
        st.floats(-0.3, 0.3),
        st.floats(-0.01, 0.01),
        st.floats(-0.01, 0.01),
        st.floats(-0.1, 0.1),
    )
)
@example(k=(-0.29762208404316853, -0.29762208404316853, 0.0, 0.0, 0.078125))  # bends short of it
def test_rays_and_projection_are_inverse_wherever_the_lens_is_accepted(k):
    try:
        one = camera(k)
    except ValueError:
        assume(False)
    pixels = grid(8.0)
    there, _ = one.project(one.center + 2.0 * one.rays(pixels))
    np.testing.assert_allclose(there, pixels, atol=1e-6)


def test_points_far_outside_the_image_stay_outside():
    one = camera()
    angle = np.linspace(0, 2 * np.pi, 60)[:, None]
    for radius in (1.0, 2.0, 4.0, 50.0):
        local = np.concatenate([radius * np.cos(angle), radius * np.sin(angle), 1 + 0 * angle], 1)
        pixels, _ = one.project(one.center + local @ one.R)
        assert not one.inside(pixels).any()


def test_a_lens_that_folds_over_is_refused():
    with pytest.raises(ValueError, match="c: the lens folds over within the image"):
        camera((-2.0,))
    with pytest.raises(ValueError, match="up to 5 numbers"):
        camera((0, 0, 0, 0, 0, 0.1))
    with pytest.raises(ValueError, match="filter_sigma must be >= 0"):
        camera(filter_sigma=-1.0)


def test_a_rig_file_has_lenses(tmp_path):
    table = """
[[cameras]]
name = "c"
position = [0, -1, 0]
target = [0, 0, 0]
fov_deg = 20
width = 80
height = 80
distortion = [-0.2, 0.05]
filter_sigma = 0.5
"""
    (tmp_path / "rig.toml").write_text(table)
    one = Rig.load(tmp_path / "rig.toml").cameras[0]
    assert one.distorted
    (tmp_path / "rig.json").write_text(json.dumps(Rig.load(tmp_path / "rig.toml").to_dict()))
    again = Rig.load(tmp_path / "rig.json").cameras[0]
    assert again.to_dict() == one.to_dict()
    assert again.filter_sigma == 0.5
    moved = one.moved(np.eye(3), np.array([0.0, 0.0, 0.1]))
    np.testing.assert_array_equal(moved.distortion, one.distortion)
    (tmp_path / "rig.toml").write_text(table.replace("-0.2", "-200"))
    with pytest.raises(RigError, match=r"rig\.toml: .*folds over"):
        Rig.load(tmp_path / "rig.toml")
