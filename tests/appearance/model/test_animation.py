"""Moving pictures: hair that sways, poses of a file, an animation that a reader opens."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from appearance.model.animation import sway, write_animation
from appearance.model.relight import three_quarter_view
from reconstruction import StrandFileError
from reconstruction.files.strands import read_poses


def test_a_sway_keeps_roots_and_lengths_and_turns_back(small):
    strands = small.tuft(40)
    poses = sway(strands, 8, 20.0)
    first = strands.offsets[:-1]
    for pose in poses:
        np.testing.assert_allclose(pose.points[first], strands.points[first], atol=1e-6)
        np.testing.assert_allclose(pose.lengths(), strands.lengths(), rtol=1e-3)
    moved = [np.abs(p.points - strands.points).max() for p in poses]
    assert max(moved) > 0.05 * strands.lengths().max()
    steps = [
        np.abs(a.points - b.points).max() for a, b in zip(poses, poses[1:] + poses[:1], strict=True)
    ]
    assert steps[-1] < 1.2 * max(steps[:-1]), "the last pose goes over into the first"
    still = sway(strands, 8, 0.0)[0]
    np.testing.assert_allclose(still.points, strands.points, atol=1e-6)
    with pytest.raises(ValueError, match="at least 2 frames"):
        sway(strands, 1, 5.0)
    with pytest.raises(ValueError, match="0 to 45 degrees"):
        sway(strands, 4, 90.0)


def test_poses_of_a_file(small, tmp_path):
    strands = small.tuft(5)
    moved = np.stack([strands.points, strands.points + 0.01])
    np.savez(tmp_path / "poses.npz", points=moved, offsets=strands.offsets)
    np.savez(tmp_path / "one.npz", points=strands.points, offsets=strands.offsets)
    np.savez(tmp_path / "bad.npz", points=moved[..., :2], offsets=strands.offsets)
    poses = read_poses(tmp_path / "poses.npz")
    np.testing.assert_array_equal([p.points for p in poses], moved)
    assert len(read_poses(tmp_path / "one.npz")) == 1
    with pytest.raises(StrandFileError, match=r"bad\.npz: points must be"):
        read_poses(tmp_path / "bad.npz")
    with pytest.raises(StrandFileError, match="no such file"):
        read_poses(tmp_path / "none.npz")


def test_an_animation_is_read_back_by_another_reader(tmp_path):
    from PIL import Image

    frames = np.zeros((5, 24, 32, 3), np.float32)
    for k in range(5):
        frames[k, :, 4 * k : 4 * k + 8, 0] = 1.0
    write_animation(tmp_path / "film.webp", frames, 1.0)
    with Image.open(tmp_path / "film.webp") as film:
        assert (film.n_frames, film.size) == (5, (32, 24))
        for k in range(5):
            film.seek(k)
            bright = np.array(film.convert("RGB"))[12, :, 0] > 128
            assert set(np.flatnonzero(bright)) <= set(range(4 * k - 2, 4 * k + 10))
            assert bright.sum() >= 6
    assert cv2.imreadanimation(str(tmp_path / "film.webp"))[0]
    with pytest.raises(ValueError, match=r"\.webp"):
        write_animation(tmp_path / "film.png", frames)


def test_the_camera_goes_round_at_one_distance(small):
    strands = small.tuft(20)
    middle = 0.5 * (strands.points.min(0) + strands.points.max(0))
    at = [three_quarter_view(strands, 32, a).center - middle for a in (0, 90, 180)]
    np.testing.assert_allclose(at[0][:2], -at[2][:2], atol=1e-6)
    assert abs(at[0][:2] @ at[1][:2]) < 1e-6
    assert at[0][0] * at[1][1] - at[0][1] * at[1][0] > 0, "counter-clockwise from above"
