"""Hair against skin: the user's word, points off the head, the light, and nothing to go by."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from scipy import ndimage

from reconstruction import Camera, Capture, Light, Mesh
from reconstruction.geometry.lights import dome_positions
from reconstruction.geometry.mesh_queries import mesh_depth
from reconstruction.images.hair_features import light_contrast, line_strength, otsu, tell_apart
from reconstruction.images.silhouettes import NoSilhouette, background_noise, silhouette
from reconstruction.light_planes import PointCloud, triangulate
from reconstruction.masks import (
    _threshold,
    distance_to,
    hair_masks,
)

RADIUS = 0.1
LIGHTS = [Light(f"l{i:02d}", p, np.ones(3)) for i, p in enumerate(dome_positions(40, 1.2, -60.0))]


def ball(radius: float, n: int = 24) -> Mesh:
    """A closed sphere of triangles with outward normals."""
    theta = np.linspace(0, np.pi, n)[:, None]
    phi = np.linspace(0, 2 * np.pi, 2 * n, endpoint=False)[None]
    grid = np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], -1
    )
    index = np.arange(n * 2 * n).reshape(n, 2 * n)
    a, b = index[:-1], index[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    quads = np.stack([a, b, c, d], axis=-1).reshape(-1, 4)
    return Mesh(radius * grid.reshape(-1, 3), np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]))


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def upper(device: Camera) -> tuple[np.ndarray, np.ndarray]:
    """The sphere's pixels and those of its upper half, which the tests give hair."""
    grid = np.stack(np.meshgrid(np.arange(device.width), np.arange(device.height)), axis=-1)
    rays = device.rays(grid)
    b = rays @ device.center
    inside = b**2 - device.center @ device.center + RADIUS**2
    point = device.center + (-b - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
    return inside > 0, (inside > 0) & (point[..., 2] > 0)


def hairy(step: dict[str, object], device: Camera) -> np.ndarray:
    """OLAT frames: matte skin below, above it fibres that mirror narrowly, each pixel its own."""
    light = LIGHTS[int(str(step["light"])[1:])]
    grid = np.stack(np.meshgrid(np.arange(device.width), np.arange(device.height)), axis=-1)
    rays = device.rays(grid)
    b = rays @ device.center
    inside = np.maximum(b**2 - device.center @ device.center + RADIUS**2, 0)
    normal = (device.center + (-b - np.sqrt(inside))[..., None] * rays) / RADIUS
    toward = light.position / np.linalg.norm(light.position)
    subject, hair = upper(device)
    matte = np.maximum(normal @ toward, 0)
    rng = np.random.default_rng(5)
    tangent = rng.normal(size=(*subject.shape, 3))
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    half = toward - rays
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    across = (half * tangent).sum(axis=-1)
    fibre = matte * np.exp(-((across / 0.12) ** 2))
    return np.asarray(np.where(hair, fibre, matte) * subject)


@pytest.fixture(scope="module")
def hairy_capture(shoot: Callable[..., Capture]) -> Capture:
    return shoot(lights=LIGHTS, extra=hairy, sweep=False)


def test_silhouettes_are_the_sphere(sphere_capture: Capture, shoot: Callable[..., Capture]) -> None:
    for capture in (sphere_capture, shoot(noise=0.02, sweep=False)):
        for device in capture.rig.cameras:
            assert iou(silhouette(capture, device.name), upper(device)[0]) > 0.93


def test_background_noise_is_measured_below_zero() -> None:
    rng = np.random.default_rng(0)
    image = rng.normal(0, 0.03, (200, 200))
    image[:80] += 5
    assert background_noise(image) == pytest.approx(0.03, rel=0.05)
    assert background_noise(np.ones(4)) == 0


def test_light_and_lines_tell_fibres_from_skin(hairy_capture: Capture) -> None:
    masks = hair_masks(hairy_capture)
    for device in hairy_capture.rig.cameras:
        mask = masks[device.name]
        assert mask.source == "light and lines"
        assert iou(mask.hair, upper(device)[1]) > 0.9
        assert not (mask.hair & mask.skin).any()
        assert np.array_equal(mask.hair | mask.skin, mask.subject)


def test_contrast_of_a_matte_ball_is_near_nothing(hairy_capture: Capture) -> None:
    device = hairy_capture.rig.cameras[0]
    subject, hair = upper(device)
    contrast = light_contrast(hairy_capture, device.name, subject)
    assert contrast is not None
    assert np.median(contrast[subject & ~hair]) < 0.25
    assert np.median(contrast[hair]) > 0.4
    assert not contrast[~subject].any()


def test_points_off_the_head_are_hair(sphere_capture: Capture) -> None:
    cloud = triangulate(sphere_capture)
    inner = hair_masks(sphere_capture, cloud, ball(0.09))  # every point stands 1 cm off
    same = hair_masks(sphere_capture, cloud, ball(0.1))
    for name in inner:
        assert inner[name].source == same[name].source == "geometry"
        assert inner[name].hair.sum() > 0.9 * inner[name].subject.sum()
        assert same[name].skin.sum() > 0.85 * same[name].subject.sum()


def test_the_users_mask_wins(shoot: Callable[..., Capture]) -> None:
    capture = shoot(sweep=False)
    (capture.path / "masks").mkdir()
    image = np.zeros((64, 64), np.uint8)
    image[10:30, 20:40] = 255
    cv2.imwrite(str(capture.path / "masks" / "left.png"), image)
    masks = hair_masks(capture, None, ball(0.1))
    assert masks["left"].source == "user"
    assert np.array_equal(masks["left"].hair, image > 0)
    assert masks["right"].source == "geometry"


def test_with_nothing_to_go_by_all_of_the_subject_may_be_hair(sphere_capture: Capture) -> None:
    mask = hair_masks(sphere_capture)["left"]
    assert mask.source == "silhouette"
    assert mask.decided == 0
    assert np.array_equal(mask.hair, mask.subject)


def test_an_empty_picture_gives_empty_masks(
    shoot: Callable[..., Capture], stage_camera: Callable[..., Camera]
) -> None:
    away = Camera.look_at("away", 32, 32, (0, -0.9, 0), (0, -2, 0), 15.0)
    capture = shoot(cameras=[away], sweep=False)
    empty = PointCloud.empty(("away",), ("proj",))
    mask = hair_masks(capture, empty, ball(0.1))["away"]
    assert not mask.subject.any()
    assert not mask.hair.any()


def test_a_camera_without_pictures_is_left_out(shoot: Callable[..., Capture]) -> None:
    capture = shoot(sweep=False)
    capture.records.clear()
    assert hair_masks(capture) == {}
    with pytest.raises(NoSilhouette, match="left"):
        silhouette(capture, "left")


def test_distances_to_a_ball() -> None:
    points = np.array([[0.105, 0, 0], [0, 0.095, 0], [0, 0, 0.15]])
    found = distance_to(ball(0.1, 60), points)
    assert found == pytest.approx([0.005, -0.005, 0.05], abs=3e-4)


def test_the_head_covers_its_outline(stage_camera: Callable[..., Camera]) -> None:
    device = stage_camera("c", 0.0)
    assert iou(np.isfinite(mesh_depth(device, ball(0.1, 40))), upper(device)[0]) > 0.93


def test_hair_that_lies_flat_on_the_head_is_hair_where_the_light_says_so():
    contrast = np.array([[1.2, 1.3, 1.1, 1.2, 0.1]])
    subject = np.ones_like(contrast, bool)
    hair, flat = np.zeros_like(subject), np.zeros_like(subject)
    hair[0, :2], flat[0, 2:] = True, True
    level = _threshold(contrast, subject, hair, flat)
    np.testing.assert_array_equal((contrast > level)[0], [True, True, True, True, False])
    # nothing is far from matte: the points' word, that it lies on the head, stands
    assert _threshold(0.2 * contrast, subject, hair, flat) == np.inf


def fur(shape: tuple[int, int], hair: np.ndarray, seed: int, noise: float = 0.01) -> np.ndarray:
    """A lit picture: smooth shading with a nose's edge, and lines two pixels wide where hair is."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]]
    skin = 1 + 0.5 * np.sin(x / 20) + 0.3 * (y > 70)
    lines = ndimage.gaussian_filter(rng.normal(size=shape), (6.0, 0.8))
    lines = 1 + 0.4 * lines / lines.std()
    return np.where(hair, 0.4 * np.maximum(lines, 0), skin) + noise * rng.normal(size=shape)


def test_lines_alone_tell_hair_in_views_of_the_face_and_of_the_back() -> None:
    subject = np.zeros((120, 120), bool)
    subject[8:112, 8:112] = True
    y, _ = np.mgrid[:120, :120]
    truth = {"face": y < 50, "back": y < 200, "nape": y < 100}
    subjects = dict.fromkeys(truth, subject)
    features = {
        name: line_strength(fur((120, 120), hair, k), subject)[None]
        for k, (name, hair) in enumerate(truth.items())
    }
    scores = tell_apart(features, subjects)
    assert scores is not None
    for name, hair in truth.items():
        assert iou(subject & (scores[name] > 0), subject & hair) > 0.8  # edges answer, too
        assert not scores[name][~subject].any()


def test_a_feature_that_says_nothing_does_not_count() -> None:
    rng = np.random.default_rng(0)
    hair = np.arange(6400).reshape(80, 80) < 4000
    good = np.where(hair, 1.0, 0.0) + 0.1 * rng.normal(size=hair.shape)
    whole = {"c": np.ones_like(hair)}
    for other in (0.1 * rng.normal(size=hair.shape), np.zeros(hair.shape)):
        scores = tell_apart({"c": np.stack([good, other])}, whole)
        assert scores is not None
        assert iou(scores["c"] > 0, hair) > 0.98


def test_one_class_is_not_split() -> None:
    rng = np.random.default_rng(1)
    whole = {"c": np.ones((90, 90), bool)}
    assert tell_apart({"c": rng.normal(size=(2, 90, 90))}, whole) is None
    assert tell_apart({"c": np.zeros((2, 90, 90))}, whole) is None
    assert tell_apart({"c": np.zeros((2, 90, 90))}, {"c": np.zeros((90, 90), bool)}) is None
    values = rng.normal(size=10_000)
    assert otsu(values)[0] == pytest.approx(0, abs=0.05)
    assert otsu(values)[1] == pytest.approx(2.65, abs=0.05)
    level, apart = otsu(np.r_[values, 8 + values])
    assert 2 < level < 5
    assert apart == pytest.approx(8, abs=0.2)
    assert otsu(np.r_[np.zeros(50), np.ones(50)])[0] == 0
    assert otsu(np.ones(5)) == (np.inf, 0.0)
