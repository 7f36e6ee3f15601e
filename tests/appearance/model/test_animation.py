"""Animations: turning views and lights, poses of a file, and the written file."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from appearance import Environment, Exposure, FittedModel, HairAppearance, HeldOut, Sampling
from appearance.bsdf.maps import HairMaps
from appearance.model.animation import (
    CELLS,
    cell_means,
    moving,
    turning_light,
    turntable,
    write_animation,
)
from appearance.model.relight import three_quarter_view
from appearance.render.environment_maps import studio
from appearance.render.smoothed import environment_smoothed
from appearance.sun_fit.fitted_appearance import FittedAppearance
from reconstruction import StrandFileError
from reconstruction.files.strands import read_poses

HAIR = HairAppearance((0.1, 0.2, 0.45), 0.3, 0.3)
SKIN = 0.5, 0.35, 0.28


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
    frames[2, 3, 4] = np.nan
    with pytest.raises(ValueError, match="NaN"):
        write_animation(tmp_path / "film.webp", frames)


def test_the_camera_goes_round_at_one_distance(small):
    strands = small.tuft(20)
    middle = 0.5 * (strands.points.min(0) + strands.points.max(0))
    at = [three_quarter_view(strands, 32, a).center - middle for a in (0, 90, 180)]
    np.testing.assert_allclose(at[0][:2], -at[2][:2], atol=1e-6)
    assert abs(at[0][:2] @ at[1][:2]) < 1e-6
    assert at[0][0] * at[1][1] - at[0][1] * at[1][0] > 0, "counter-clockwise from above"


def test_a_turning_map_keeps_its_light_and_turns_counter_clockwise():
    rng = np.random.default_rng(0)
    envmap = rng.uniform(size=(33, 50, 3))
    solid = -np.diff(np.cos(np.linspace(0, np.pi, CELLS[0] + 1)))
    height = np.repeat(solid, CELLS[1])[:, None]
    z = -np.diff(np.cos(np.linspace(0, np.pi, 34)))[:, None, None]
    mean = (envmap * z).sum((0, 1)) / (50 * z.sum())
    for turned in (0.0, 0.27, 1.4):
        cells = cell_means(envmap, turned)
        np.testing.assert_allclose((cells * height).sum(0) / height.sum(), mean, rtol=1e-6)
    spot = np.zeros((40, 96, 3))
    spot[20, 48] = 1.0  # along +x, and a quarter of a turn on along +y: columns go clockwise
    at = [cell_means(spot, t).sum(1).argmax() % CELLS[1] for t in (0.0, 0.25)]
    assert at == [12, 6]


def model_of(small):
    known = FittedAppearance(HAIR, (0.4, 0.3, 0.2), SKIN, Exposure(1.0), 0.1, 0.1, 0.1, HeldOut())
    maps = HairMaps.of(HAIR)
    return FittedModel(strands=small.tuft(60), head=small.ball(), appearance=known, maps=maps)


def test_a_ball_under_turning_light_is_as_an_environment_renders_it(small):
    model = model_of(small)
    room = Environment(studio(40))
    frames = turning_light(model, room, 4, 16, Sampling(8, 4))
    for k, frame in enumerate(frames):
        turned = np.roll(room.envmap, -20 * k, axis=1)
        camera = three_quarter_view(model.strands, 16)
        true = environment_smoothed(model.scene(), camera, turned, Sampling(16, 4))
        assert np.abs(frame - true).mean() < 0.1 * true.mean()
    means = frames.mean(axis=(1, 2, 3))
    assert means.max() > 1.2 * means.min(), "the room is not alike from all sides"
    with pytest.raises(ValueError, match="needs a frame"):
        turning_light(model, room, 0, 16, Sampling(1))


def test_hair_at_rest_does_not_flicker_and_is_lit_as_a_picture_of_it(small):
    model, room = model_of(small), Environment(studio(40))
    camera, few = three_quarter_view(model.strands, 16), Sampling(2, 4)
    one, other = moving(model, [model.strands] * 2, camera, ((), (room,)), few)
    np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-3 * one.max())
    picture = environment_smoothed(model.scene(), camera, room.envmap, few)
    np.testing.assert_allclose(one, picture, rtol=1e-3, atol=1e-3 * one.max())


@pytest.mark.parametrize("kind", ["turntable", "turning_light", "moving"])
def test_animations_show_a_room_as_it_is_weighed_and_turned(small, kind):
    model, few = model_of(small), Sampling(1, 2)
    camera, poses = three_quarter_view(model.strands, 8), [small.tuft(60)] * 2

    def frames(room):
        if kind == "moving":
            return moving(model, poses, camera, ((), (room,)), few)
        return {"turntable": turntable, "turning_light": turning_light}[kind](
            model, room, 2, 8, few
        )

    envmap = studio(8)
    quarter = np.roll(envmap, -4, axis=1)  # counter-clockwise seen from above: to the left
    red = np.array([1.0, 0.0, 0.0], np.float32)
    shown = frames(Environment(envmap, 90.0, red))
    np.testing.assert_allclose(shown, frames(Environment(quarter * red)), rtol=1e-6)
    assert shown.any()
    assert not shown[..., 1:].any()
