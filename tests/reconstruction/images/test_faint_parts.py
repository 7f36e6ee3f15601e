"""Dark hair below the noise of a pixel: shares of known areas."""

import json

import numpy as np
import pytest

from reconstruction import import_folder, write_exr
from reconstruction.images.faint_parts import LARGEST_SHARE, faint_share, faint_warnings

y, x = np.indices((240, 240)) - 119.5
RADIUS = np.hypot(x, y)
FACE, HAIR = RADIUS < 50, (RADIUS >= 50) & (RADIUS < 80)


def picture(hair: float, noise: float, seed: int = 0) -> np.ndarray:
    """A face of 1 in hair of the radiance `hair`."""
    grain = np.random.default_rng(seed).normal(0, noise, FACE.shape) if noise else 0.0
    return (FACE + hair * HAIR + grain).astype(np.float32)


@pytest.mark.parametrize("signal", [2.0, 3.0])
def test_the_share_is_that_of_the_area(signal) -> None:
    """A ring of 50 to 80 pixels is 61 % of the disc; its borders are not certain."""
    image = picture(signal * 0.02, 0.02)
    assert 0.45 < faint_share(image, FACE) < 0.64


def test_neither_noise_nor_outlines_nor_a_dim_wall_are_faint_hair() -> None:
    assert max(faint_share(picture(0.0, n), FACE) for n in (0.0, 1e-6, 0.02, 0.3)) < 0.01
    soft = np.clip((53 - RADIUS) / 6, 0, 1) + np.random.default_rng(0).normal(0, 0.02, FACE.shape)
    assert faint_share(soft.astype(np.float32), soft > 0.1) < LARGEST_SHARE
    assert faint_share(picture(0.0, 0.02) + np.float32(0.03), FACE) == 0.0
    assert faint_share(np.zeros_like(soft), np.zeros(FACE.shape, bool)) == 0.0
    noise = soft.astype(np.float32) - 0.5
    assert faint_share(noise, np.ones(FACE.shape, bool)) == 0.0
    assert faint_share(noise[:1, :1], np.ones((1, 1), bool)) == 0.0


def test_a_capture_is_warned_of_unless_masks_are_given(tmp_path, two_cameras) -> None:
    """Frames of four lights; a user's mask of the camera ends the warning."""

    names = [c.name for c in two_cameras.cameras]
    cameras = [
        {"id": c.name, "width": 240, "height": 240, "R": c.R.tolist(), "t": c.t.tolist()}
        | {"K": [[900, 0, 119.5], [0, 900, 119.5], [0, 0, 1]]}
        for c in two_cameras.cameras
    ]
    lights = [{"id": k, "position": [k - 1, -1, 1], "intensity": [1, 1, 1]} for k in range(4)]
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "cameras.json").write_text(json.dumps({"cameras": cameras}))
    (tmp_path / "in" / "lights.json").write_text(json.dumps({"lights": lights}))
    for k, name in enumerate(names):
        (tmp_path / "in" / "images" / name).mkdir(parents=True)
        for light in range(4):
            image = np.repeat(picture(0.03, 0.02, 9 * k + light)[..., None], 3, axis=2)
            write_exr(tmp_path / "in" / "images" / name / f"light_{light:02d}.exr", image)
    capture = import_folder(tmp_path / "in", tmp_path / "capture")
    warnings = faint_warnings(capture)
    assert len(warnings) == 1
    assert all(f"{name} " in warnings[0] for name in names)
    assert "masks/CAMERA.png" in warnings[0]
    known = dict.fromkeys(names, FACE | HAIR)
    assert faint_warnings(capture, known) == []
