"""Lenses that bend lines: what is reconstructed through them is what pinholes give."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from reconstruction import Camera, Capture, CaptureError, Light, Model, Step
from reconstruction.arrays import Floats
from reconstruction.capture.frame_cache import cache_bytes, cached_frames
from reconstruction.geometry.blocks import block_means
from reconstruction.geometry.lens import Lens
from reconstruction.images.silhouettes import silhouette
from reconstruction.light_planes import solve_motion, triangulate

BARREL, PINCUSHION = [-3.5, 6.0, 0.03, -0.03], [4.0, 0.0, -0.03, 0.05]
POSES = [(np.eye(3), np.array([0.0, 2e-4 * k, -3e-4 * k])) for k in range(4)]


@pytest.fixture(scope="module")
def cameras(stage_camera: Callable[..., Camera]) -> list[Camera]:
    return [stage_camera(n, a, 10.0, size=80) for n, a in (("left", -40), ("right", 35))]


@pytest.fixture(scope="module")
def bent(shoot: Callable[..., Capture], cameras: list[Camera]) -> Capture:
    lenses = [replace(c, distortion=k) for c, k in zip(cameras, (BARREL, PINCUSHION), strict=True)]
    return shoot(cameras=lenses, poses=POSES, full_scale=0.9)


@pytest.fixture(scope="module")
def plain(shoot: Callable[..., Capture], cameras: list[Camera]) -> Capture:
    return shoot(cameras=cameras, poses=POSES, full_scale=0.9)


def test_points_and_motion_are_those_of_pinholes(bent: Capture, plain: Capture) -> None:
    capture = bent.view(undistorted=True)
    assert all(0.85 < lens.kept() <= 1 for lens in capture.lenses.values())
    clouds, shifts = [], []
    for source in (plain, capture):
        cloud = triangulate(source)
        motion = solve_motion(source, cloud)
        assert motion.determined == 6
        shifts.append(motion.translations[-1])
        cloud = triangulate(source, motion=replace(motion, between="hold"))
        clouds.append(np.abs(np.linalg.norm(cloud.points, axis=1) - 0.1))
    assert len(clouds[1]) > 0.9 * len(clouds[0])
    assert np.median(clouds[1]) < 1.3 * np.median(clouds[0]) + 1e-5
    assert np.percentile(clouds[1], 90) < 2 * np.percentile(clouds[0], 90)
    assert np.abs(shifts[1] - shifts[0]).max() < 5e-5


def test_frames_masks_and_saturation_are_straight(bent: Capture) -> None:
    (bent.path / "masks").mkdir(exist_ok=True)
    capture = bent.view(undistorted=True)
    for device in bent.rig.cameras:
        shot = silhouette(bent, device.name)
        cv2.imwrite(str(bent.path / "masks" / f"{device.name}.png"), shot.astype(np.uint8) * 255)
        straight, mask = silhouette(capture, device.name), capture.mask(device.name)
        assert mask is not None
        assert mask.shape == straight.shape
        assert (mask ^ straight).sum() < 0.04 * mask.sum()
        again = capture.mask_as_shot(device.name, straight)
        assert (again ^ shot).sum() < 0.04 * shot.sum()
        assert bent.mask_as_shot(device.name, shot) is shot
        step = next(s for s in bent.of_kind("scanline") if s.row == 20)
        for image in (capture.frame(step, device.name), bent.frame(step, device.name)):
            assert image.min() == 0  # nothing rings
        response, full = capture.response_and_saturated(step, device.name)
        assert full.any() == bent.saturated(step, device.name).any()
        assert response[~full].max() < 0.95
        assert np.array_equal(capture.saturated(step, device.name), full)


def test_a_models_masks_follow_the_view(bent: Capture, tmp_path: Path) -> None:
    model = Model(tmp_path).create()
    shot = silhouette(bent, "left")
    model.write_mask("left", "hair", shot)
    for view in (bent.view(undistorted=True), bent.view(undistorted=True, reduced=2)):
        mask = model.mask("left", "hair", view)
        assert (mask ^ silhouette(view, "left")).sum() < 0.1 * mask.sum()
        assert model.mask("left", "skin", view).shape == mask.shape


def test_a_wave_of_eleven_pixels_is_resampled_to_two_hundredths() -> None:
    camera = Camera.look_at("c", 96, 80, (0, -1, 0), (0, 0, 0), 30.0)
    lens = replace(camera, distortion=[-0.4, 0.1, 0.005, 0.002])
    way = Lens.of(lens)

    def wave(device: Camera) -> np.ndarray:
        x, y = np.meshgrid(np.arange(device.width), np.arange(device.height))
        rays = device.rays(np.stack([x, y], axis=-1))
        u, v = rays[..., 0] / rays[..., 1], rays[..., 2] / rays[..., 1]
        picture = 1 + 0.5 * np.sin(100 * u) * np.cos(80 * v)
        return np.repeat(picture[..., None], 3, axis=-1).astype(np.float32)

    assert way.undistorted.width > 96  # a barrel's middle is drawn out
    error = np.abs(way.undistort(wave(lens)) - wave(way.undistorted))
    assert np.percentile(error, 99) < 0.02
    assert error.max() < 0.04


@pytest.mark.parametrize("lens", [[0.0], [-0.4, 0.1, 0.005, 0.002]])
@pytest.mark.parametrize("by", [2, 3, 7])
def test_block_means_are_what_the_reduced_camera_sees(lens: list[float], by: int) -> None:
    camera = replace(
        Camera.look_at("c", 97, 83, (0, -1, 0), (0, 0, 0), 30.0), distortion=lens, filter_sigma=0.5
    )

    def gradient(device: Camera) -> np.ndarray:
        x, y = np.meshgrid(np.arange(device.width), np.arange(device.height))
        rays = device.rays(np.stack([x, y], axis=-1))
        return np.stack([rays[..., 0] / rays[..., 1], rays[..., 2] / rays[..., 1]], axis=-1)

    small = camera.reduced(by)
    assert (small.width, small.height) == (97 // by, 83 // by)
    observed = block_means(gradient(camera), by)
    assert np.abs(observed - gradient(small)).max() < 0.02 * 2 * np.tan(np.radians(15)) / 97 * by
    # a Gaussian of 0.5 pixels and a block of n pixels have the variance of both
    assert small.filter_sigma * by == pytest.approx(np.sqrt(0.25 + (by**2 - 1) / 12))
    assert camera.reduced(1) is camera


def test_a_reduced_capture_has_its_points_in_the_same_place(bent: Capture, plain: Capture) -> None:
    whole = triangulate(plain.view(undistorted=True))
    for capture in (plain.view(reduced=2), bent.view(undistorted=True).view(reduced=2)):
        cloud = triangulate(capture)
        assert len(cloud) > 0.15 * len(whole)  # a quarter of the pixels
        off = np.abs(np.linalg.norm(cloud.points, axis=1) - 0.1)
        assert np.median(off) < 1e-3


def test_masks_and_saturation_of_reduced_pictures(bent: Capture) -> None:
    (bent.path / "masks").mkdir(exist_ok=True)
    capture = bent.view(reduced=3)
    step = next(s for s in bent.of_kind("scanline") if s.row == 20)
    for device in capture.rig.cameras:
        assert (device.width, device.height) == (26, 26)  # of 80
        shot = silhouette(bent, device.name)
        cv2.imwrite(str(bent.path / "masks" / f"{device.name}.png"), shot.astype(np.uint8) * 255)
        for view in (capture, capture.view(undistorted=True)):
            mask = view.mask(device.name)
            assert mask is not None
            assert mask.shape == silhouette(view, device.name).shape
            again = view.mask_as_shot(device.name, mask)
            assert again.shape == shot.shape
            assert (again ^ shot)[:78, :78].sum() < 0.15 * shot.sum()  # blocks along an outline
        response, full = capture.response_and_saturated(step, device.name)
        whole, wholly = bent.response_and_saturated(step, device.name)
        assert full.any() == wholly[:78, :78].any()
        assert response.sum() * 9 == pytest.approx(whole[:78, :78].sum(), rel=1e-4)
        assert np.array_equal(
            capture.view(reduced=1).frame(step, device.name), bent.frame(step, device.name)
        )
    with pytest.raises(CaptureError, match="80x80 pixels cannot be reduced by 81"):
        bent.view(reduced=81)


def test_cameras_without_a_lens_are_read_as_they_are(plain: Capture) -> None:
    view = plain.view(undistorted=True)
    assert not view.lenses
    step, camera = plain.steps[0], plain.rig.cameras[0]
    assert np.array_equal(view.frame(step, camera.name), plain.frame(step, camera.name))


def test_a_view_is_a_part_and_leaves_the_whole_alone(bent: Capture) -> None:
    lights = bent.olat_lights()
    view = bent.view(cameras=["right"], undistorted=True).view(lights=lights[1:2])
    assert [c.name for c in view.rig.cameras] == ["right"]
    assert view.olat_lights() == lights[1:2]
    assert not view.rig.cameras[0].distorted
    assert view.view(undistorted=False).rig.cameras == bent.rig.cameras[1:]
    assert len(bent.rig.cameras) == 2
    assert bent.olat_lights() == lights
    assert bent.without_lights(lights[:1]).olat_lights() == lights[1:]
    with pytest.raises(CaptureError, match="no light nope"):
        bent.without_lights(["nope"])
    with pytest.raises(CaptureError, match="no camera middle; its 2 are left, right"):
        bent.view(cameras=["middle"])


def test_reduced_frames_of_single_lights_are_read_once(
    shoot: Callable[..., Capture], bent: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Kept, they are the same numbers; nothing is left behind, also of what was killed."""
    lights = [Light(f"l{i}", np.array([i, -1.0, 0.5]), np.ones(3)) for i in range(2)]
    capture = shoot(cameras=bent.rig.cameras, lights=lights, sweep=False)
    capture = capture.view(undistorted=True, reduced=3)
    files: list[Path] = []
    plain = Capture._read

    def counted(self: Capture, step: Step, camera: str) -> tuple[Floats, dict[str, float | str]]:
        files.append(self._file(step, camera))
        image, attributes = plain(self, step, camera)
        top = float(image.max()) + 1
        image[:40, :40] = top  # saturated
        return image, attributes | {"fullScale": top}

    monkeypatch.setattr(Capture, "_read", counted)
    (tmp_path / "frames-killed").mkdir()
    with cached_frames(capture, tmp_path) as kept:
        assert [path.name for path in tmp_path.iterdir()] != ["frames-killed"]
        assert cache_bytes(capture.view(undistorted=False)) == 13 * 4 * 26 * 26
        for step in (*capture.of_kind("olat"), *capture.of_kind("dark")):
            for camera in capture.rig.cameras:
                image, saturated = capture.response_and_saturated(step, camera.name)
                assert 0 < saturated.mean() < 1
                files.clear()
                for _ in range(2):
                    again = kept.response_and_saturated(step, camera.name)
                    np.testing.assert_array_equal(again[0], image)
                    np.testing.assert_array_equal(again[1], saturated)
                    np.testing.assert_array_equal(kept.frame(step, camera.name), image)
                assert len(files) == (1 if step.kind == "olat" else 4)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
    for view in (bent, capture):
        with cached_frames(view, tmp_path) as kept:
            assert kept is view
