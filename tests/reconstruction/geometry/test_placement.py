"""Cameras and lights of others in our world: what does not fit is named with its option."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reconstruction import Camera, Light
from reconstruction.geometry.lights import dome_positions
from reconstruction.geometry.placement import (
    PlacementError,
    PlacementOptions,
    Sight,
    check_cameras,
    check_lights,
    placed,
    placed_lights,
    resized,
)

Y_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]])  # from our world to one with y up
FLIP = np.diag([1.0, -1.0, -1.0])


def stage(roll: float = 0.0) -> list[Camera]:
    """Eight cameras 1.2 m from a head that is not quite in their midst."""
    return [
        Camera.look_at(
            f"cam_{i}",
            300,
            400,
            1.2 * np.array([np.cos(a), np.sin(a), 0.2 + 0.3 * np.sin(3 * a)]),
            0.02 * np.array([np.sin(5 * a), np.cos(7 * a), 0]),
            25,
            roll,
        )
        for i, a in enumerate(np.linspace(0, 4.5, 8))
    ]


def in_world(cameras: list[Camera], turn: np.ndarray, unit: float) -> list[Camera]:
    """The same cameras where a world turned by `turn` counts in `unit` metres."""
    out = []
    for c in cameras:
        R, center = c.R @ turn.T, turn @ c.center / unit
        out.append(replace(c, R=R, t=-R @ center))
    return out


def check(cameras: list[Camera], **options) -> list[str]:
    requested = PlacementOptions(**options)
    return check_cameras(placed(cameras, requested, "opencv"), requested, "opencv")


def test_a_good_stage_passes_and_says_how_large_it_is() -> None:
    (note,) = check(stage())
    assert note.startswith("cameras stand 1.2")
    assert "0.5" in note  # 2 · 1.22 · tan(12.5°)
    assert check(stage(roll=90)) == [note]


@pytest.mark.parametrize(("unit", "name", "far"), [(1e-3, "mm", "1.2. km"), (1e-2, "cm", "12. m")])
def test_a_wrong_unit_is_named(unit: float, name: str, far: str) -> None:
    others = in_world(stage(), np.eye(3), unit)
    with pytest.raises(PlacementError, match=rf"stand {far} from .*give --unit {name}"):
        check(others)
    for found, truth in zip(
        placed(others, PlacementOptions(unit=name), "opencv"), stage(), strict=True
    ):
        np.testing.assert_allclose(found.center, truth.center, atol=1e-12)
    with pytest.raises(PlacementError, match="give --unit m"):
        check(stage(), unit="mm")
    assert check(in_world(stage(), np.eye(3), 0.3), unit=0.3)


@pytest.mark.parametrize("height", [-1.5, -1.2, 0.0, 1.0])
def test_a_good_stage_passes_wherever_its_origin_is(height: float) -> None:
    """Eight cameras before a face, two upright and two on their side by turns. With the origin on
    the floor they were taken for camera-to-world poses."""
    head, cameras = np.array([0, 0, -height]), []
    for i, azimuth in enumerate(np.radians(np.linspace(-40, 40, 8))):
        rise, roll = np.radians(20 * (i % 2)), 90 * (i // 2 % 2)
        level = np.cos(rise) * np.array([np.sin(azimuth), -np.cos(azimuth)])
        place = head + np.append(level, np.sin(rise))
        cameras.append(Camera.look_at(f"cam_{i}", 1400, 1000, place, head, 25, roll))
    (note,) = check(cameras, up="z")
    assert note.startswith("cameras stand 1.00 m")


def test_a_world_with_y_up_is_named() -> None:
    others = in_world(stage(), Y_UP, 1.0)
    with pytest.raises(PlacementError, match=r" axis y .* give --up y "):
        check(others)
    assert any(n.startswith("--up z was applied, but") for n in check(others, up="z"))
    assert not any("--up" in n for n in check(stage(), up="z"))
    for found, truth in zip(
        placed(others, PlacementOptions(up="y"), "opencv"), stage(), strict=True
    ):
        np.testing.assert_allclose(found.R, truth.R, atol=1e-12)
        np.testing.assert_allclose(found.center, truth.center, atol=1e-12)
    for up, axis in (("-y", [0, -1, 0]), ("x", [1, 0, 0]), ("-x", [-1, 0, 0]), ("-z", [0, 0, -1])):
        light = Light("a", np.array(axis), np.ones(3), orientation=np.eye(3))
        (found,) = placed_lights([light], PlacementOptions(up=up))
        np.testing.assert_allclose(found.position, [0, 0, 1], atol=1e-12)
        assert np.linalg.det(found.orientation) > 0


def test_a_world_upside_down_is_named() -> None:
    with pytest.raises(PlacementError, match=r" axis -z .*give --up -z"):
        check(in_world(stage(), FLIP, 1.0))


def test_wrong_camera_axes_are_named() -> None:
    others = [replace(c, R=FLIP @ c.R, t=FLIP @ c.t) for c in stage()]
    with pytest.raises(PlacementError, match=r": give --camera-axes opengl"):
        check(others)
    assert check(others, camera_axes="opengl") == check(stage())


def test_poses_the_other_way_round_are_named() -> None:
    others = [replace(c, R=c.R.T, t=c.center) for c in stage()]
    with pytest.raises(PlacementError, match="camera-to-world"):
        check(others)


def test_single_cameras_that_look_elsewhere_are_named() -> None:
    cameras = stage() + [replace(c, name=f"{c.name}_b") for c in stage(5)]
    R = cameras[3].R @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    cameras[3] = replace(cameras[3], R=R, t=-R @ cameras[3].center)
    assert check(cameras)[0].startswith("cam_3: ")
    assert np.linalg.norm(Sight.of(cameras).point) < 0.05
    few = cameras[:4]
    with pytest.raises(PlacementError, match=r"1 of 4 cameras .*: cam_3;"):
        check(few)


def test_lights_in_another_unit_are_named() -> None:
    lights = [Light(f"l{i}", p, np.ones(3)) for i, p in enumerate(dome_positions(40, 1.5))]
    check_lights(stage(), lights, "m")
    far = [replace(li, position=1000 * li.position) for li in lights]
    with pytest.raises(PlacementError, match=r"lights stand 1\.5 km .*give --light-unit mm"):
        check_lights(stage(), far, "m")
    again = placed_lights(far, PlacementOptions(light_unit="mm"))
    np.testing.assert_allclose([li.position for li in again], [li.position for li in lights])


def test_intrinsics_for_another_size_are_scaled() -> None:
    """A point on a pixel's corner stays on that corner, whatever the pixels' size."""
    camera = stage()[2]
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (50, 3))
    small = resized(camera, 75, 100)
    np.testing.assert_allclose(
        (small.project(points)[0] + 0.5) * 4, camera.project(points)[0] + 0.5, atol=1e-9
    )
    assert resized(camera, 300, 400) is camera
    with pytest.raises(PlacementError, match="300x400 pixels, the image has 400x300: rotate"):
        resized(camera, 400, 300)
    with pytest.raises(PlacementError, match="cropped"):
        resized(camera, 300, 300)
