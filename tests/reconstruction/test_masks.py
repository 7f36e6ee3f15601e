"""Hair against skin: the user's word, points off the head, the light, and nothing to go by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from reconstruction import Camera, Capture, CaptureWriter, Light, Mesh, Rig, Step
from reconstruction.geometry.lights import dome_positions
from reconstruction.geometry.mesh_queries import mesh_depth
from reconstruction.images.hair_features import (
    FAINTEST_GLOSS,
    clear_classes,
    looks,
    matte_fit,
    two_classes,
)
from reconstruction.images.silhouettes import (
    NoSilhouette,
    background,
    background_noise,
    lit_rgb,
    noise_of_frames,
    silhouette,
)
from reconstruction.light_planes import PointCloud, triangulate
from reconstruction.mask_geometry import distance_to
from reconstruction.masks import (
    MOST_DISAGREEMENT,
    HairMask,
    disagreements,
    hair_masks,
    report_agreement,
    usable_masks,
)
from reconstruction.report.report import Stage

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


def test_the_noise_of_frames_that_hair_fills_is_that_of_the_dark_ones() -> None:
    """No pixel of the first frame is dark: taken alone, its darkest hair is clipped black."""
    rng = np.random.default_rng(0)
    frames = rng.normal(0, 1e-3, (6, 80, 80))
    frames[0] += rng.gamma(1.0, 0.1, (80, 80)) + 5e-3
    frames[1, :40] += 1.0
    assert background_noise(frames[0]) > 2e-3
    assert noise_of_frames(frames) == pytest.approx(1e-3, rel=0.05)
    assert noise_of_frames(frames, most=9000) == pytest.approx(1e-3, rel=0.1)


@pytest.mark.parametrize("frames", [1, 40])
def test_the_background_of_frames_with_clipped_black_is_found(frames: int) -> None:
    """Sums of frames that have lost what was below zero; 60 % is background, the subject dim."""
    rng, sigma = np.random.default_rng(0), 0.01
    subject = np.zeros((100, 100), bool)
    subject[20:80, 20:80] = True
    shots = rng.normal(0, sigma, (frames, 100, 100, 3)) + 0.2 * subject[..., None]
    image = np.maximum(shots, 0).mean(axis=-1).sum(axis=0)
    level, noise = background(image)
    true = image[~subject]
    assert level == pytest.approx(true.mean(), rel=0.35)
    assert noise == pytest.approx(true.std(), rel=0.4)
    assert iou(image > level + 5 * noise, subject) > 0.999
    black = 1.0 * subject
    assert background(black) == (0, 0)


def test_a_saturated_highlight_does_not_move_the_matte_surface() -> None:
    rng, lights = np.random.default_rng(3), dome()
    matte = 0.4 * np.maximum(facing(rng, 300) @ lights.T, 0)
    shine = np.zeros(matte.shape, bool)
    shine[np.arange(300), matte.argmax(axis=1)] = True
    cut = np.where(shine, 0.6, matte)  # where the sensor is full
    gloss, albedo = matte_fit(cut, lights, known=~shine)
    np.testing.assert_allclose(albedo, 0.4, rtol=0.03)
    assert np.median(matte_fit(cut, lights)[1]) > 1.02 * np.median(albedo)
    assert np.median(gloss) > np.median(
        matte_fit(matte, lights)[0]
    )  # what is above it still shines


def test_a_blown_all_on_frame_is_not_what_lines_are_read_from(tmp_path: Path) -> None:
    """The sum of single lights is, which holds what the other has lost."""
    device = Camera.look_at("cam", 8, 8, (0, -1, 0), (0, 0, 0), 10.0)
    lights = tuple(Light(n, np.array((x, -1.0, 0)), np.ones(3)) for n, x in (("a", 0), ("b", 1)))
    steps = [Step(0, "all_on", 0.02), Step(1, "olat", 0.02, light="a")]
    steps.append(Step(2, "olat", 0.02, light="b"))
    truth = np.linspace(0.2, 0.9, 64, dtype=np.float32).reshape(8, 8, 1).repeat(3, axis=2)
    for name, shown in (("blown", 0.5), ("whole", 5.0)):
        rig = Rig("r", (device,), lights)
        writer = CaptureWriter.create(tmp_path / name, rig, {"steps": steps})
        for step in steps:
            image = np.minimum(4 * truth if step.kind == "all_on" else truth, shown * 2)
            writer.write_frame(step, "cam", image, full_scale=shown * 2)
        writer.finish("completed", {})
        found = lit_rgb(Capture(tmp_path / name), "cam")
        np.testing.assert_allclose(found, (2 if name == "blown" else 4) * truth, rtol=1e-5)


def test_reflectance_separates_fibres_from_skin(hairy_capture: Capture) -> None:
    masks = hair_masks(hairy_capture)
    for device in hairy_capture.rig.cameras:
        mask = masks[device.name]
        assert mask.source == "reflectance"
        assert iou(mask.hair, upper(device)[1]) > 0.9
        assert not (mask.hair & mask.skin).any()
        assert np.array_equal(mask.hair | mask.skin, mask.subject)


def test_a_lamp_that_gives_no_light_does_not_move_the_masks(hairy_capture: Capture) -> None:
    """The rig says of one lamp that it is dark; what its frames hold came from elsewhere."""
    dark = replace(LIGHTS[10], intensity=np.zeros(3))
    capture = hairy_capture.view()
    lights = (*LIGHTS[:10], dark, *LIGHTS[11:])
    capture.rig = replace(capture.rig, lights=lights)
    for name, mask in hair_masks(capture).items():
        assert iou(mask.hair, upper(capture.rig.camera(name))[1]) > 0.94


def dome(count: int = 60) -> np.ndarray:
    positions = dome_positions(count, 1.2, -60.0)
    return np.asarray(positions / np.linalg.norm(positions, axis=1, keepdims=True))


def facing(rng: np.random.Generator, count: int) -> np.ndarray:
    """Unit normals `(count, 3)` of what a camera sees from −y."""
    normals = rng.normal(size=(count, 3)) - [0, 2, 0]
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03])
def test_gloss_is_that_of_the_true_signal_at_any_noise(noise: float) -> None:
    """Matte surfaces have none, half in shadow or not; Kajiya's fibres do: sin is no cosine."""
    rng, lights = np.random.default_rng(2), dome()
    normals = facing(rng, 400)
    matte = np.maximum(normals @ lights.T, 0)
    hidden = matte * (lights @ [1, 0, 0] > -0.2)  # an occluder takes the lights of one side
    tangents = np.cross(normals, rng.normal(size=normals.shape))
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    along = tangents @ lights.T
    half = lights - [0, 1, 0]
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    fibres = matte * (0.3 * np.sqrt(1 - along**2) + np.exp(-((tangents @ half.T / 0.25) ** 2)))

    def gloss(values: np.ndarray) -> float:
        shot = 0.4 * values + noise * rng.normal(size=values.shape)
        found, albedo = matte_fit(shot, lights, len(lights) * noise**2)
        if values is matte:
            assert np.median(albedo) == pytest.approx(0.4, rel=0.05)
        return float(np.median(found))

    assert gloss(matte) < 0.05
    assert gloss(hidden) < 0.05
    assert gloss(fibres) > 0.12


def test_a_light_that_is_nearer_than_the_others_is_no_gloss() -> None:
    """A matte wall under Lambert's law and the inverse square; one light in eight is at 0.7."""
    rng = np.random.default_rng(4)
    distance = np.where(np.arange(48) % 8 == 0, 0.84, 1.2)
    lights = {
        f"l{i}": Light(f"l{i}", r * p, np.full(3, 8.0))
        for i, (r, p) in enumerate(zip(distance, dome(48), strict=True))
    }
    normals = facing(rng, 400)

    def frame(name: str, _camera: str) -> tuple[np.ndarray, np.ndarray]:
        away = lights[name].position
        light = 8.0 * np.maximum(normals @ away, 0) / np.linalg.norm(away) ** 3
        image = np.repeat(0.4 * light, 9)[:, None, None] * np.ones(3)
        return image.reshape(400, 9, 3).astype(np.float32), np.zeros((400, 9), bool)

    capture: Any = SimpleNamespace(
        olat_lights=lambda: list(lights),
        has_light=lambda *_: True,
        rig=SimpleNamespace(light=lights.__getitem__),
        light=frame,
    )
    subject = np.zeros((400, 9), bool)
    subject[1::3, 4] = True  # of rows whose neighbours are left out
    found = looks(capture, "c", subject)
    assert found is not None
    assert np.quantile(found[0], 0.95) < FAINTEST_GLOSS


def crown(cameras: tuple[Camera, ...], names: tuple[str, ...]) -> PointCloud:
    """Points 6 mm off the ball's upper third, as the cameras would triangulate them."""
    clouds = [PointCloud.empty(names, ("proj",))]
    for number, device in enumerate(cameras):
        y, x = np.nonzero(upper(device)[1])
        rays = device.rays(np.stack([x, y], axis=1))
        b = rays @ device.center
        reach = np.maximum(b**2 - device.center @ device.center + (RADIUS + 6e-3) ** 2, 0)
        points = device.center + (-b - np.sqrt(reach))[:, None] * rays
        keep = points[:, 2] > 0.04
        n = int(keep.sum())
        clouds.append(
            PointCloud(
                points=points[keep],
                covariance=np.tile(1e-8 * np.eye(3), (n, 1, 1)),
                view=-rays[keep],
                pixel=np.stack([x, y], axis=1)[keep],
                camera=np.full(n, number),
                projector=np.zeros(n),
                row=np.zeros(n),
                step=np.zeros(n),
                brightness=np.ones(n),
                weight=np.ones(n),
                cameras=names,
                projectors=("proj",),
            )
        )
    return PointCloud.merged(clouds)


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03])
def test_flat_hair_on_a_head_is_found_at_any_noise(
    shoot: Callable[..., Capture], noise: float
) -> None:
    """Grey fibres on grey skin; a third of the hair has points, the rest lies on the head."""
    capture = shoot(lights=LIGHTS, extra=hairy, sweep=False, noise=noise)
    cameras = capture.rig.cameras
    masks = hair_masks(capture, crown(cameras, tuple(c.name for c in cameras)), ball(0.1, 40))
    for device in cameras:
        subject, hair = upper(device)
        assert iou(masks[device.name].hair & subject, hair) > 0.92
        assert not (masks[device.name].hair & masks[device.name].skin).any()


def test_masks_that_contradict_each_other_are_warned_of(
    sphere_capture: Capture, stage_camera: Callable[..., Camera]
) -> None:
    cameras = [stage_camera(str(k), 30.0 * k) for k in range(4)]
    masks = {}
    for device in cameras:
        subject, hair = upper(device)
        masks[device.name] = HairMask(subject, hair, subject & ~hair, "user", 1.0)
    head = ball(0.1, 40)
    found = disagreements(masks, cameras, None, head)
    assert set(found) == set(masks)
    assert max(found.values()) < 0.05

    lost = masks["1"].hair.copy()
    lost[:, lost.shape[1] // 2 :] = False
    wrong = HairMask(masks["1"].subject, lost, masks["1"].subject & ~lost, "geometry", 1.0)
    found = disagreements(masks | {"1": wrong}, cameras, None, head)
    assert found["1"] == pytest.approx(0.25, abs=0.08)  # of its pixels, half of the hair
    assert found["1"] > max(v for k, v in found.items() if k != "1")
    assert found["1"] > MOST_DISAGREEMENT

    stage = Stage("masks")
    both = {"left": masks["0"], "right": masks["1"]}
    swapped = both | {
        "right": HairMask(both["right"].subject, both["right"].skin, both["right"].hair, "user", 1)
    }
    report_agreement(sphere_capture, both, None, None, stage)
    assert stage.figures["disagreement"] == {}  # nothing says where their pixels are
    report_agreement(sphere_capture, swapped, None, head, stage)
    assert "right" in str(stage.warnings[-1])


def test_points_off_the_head_are_hair(sphere_capture: Capture) -> None:
    cloud = triangulate(sphere_capture)
    inner = hair_masks(sphere_capture, cloud, ball(0.09))  # every point stands 1 cm off
    same = hair_masks(sphere_capture, cloud, ball(0.1))
    for name in inner:
        assert inner[name].source == same[name].source == "geometry"
        assert inner[name].hair.sum() > 0.9 * inner[name].subject.sum()
        assert same[name].skin.sum() > 0.85 * same[name].subject.sum()


def test_matte_parts_beside_the_head_are_not_hair(hairy_capture: Capture) -> None:
    """A head of 6 cm in a ball of 10 cm whose lower half is matte: shoulders under hair."""
    for name, mask in hair_masks(hairy_capture, head=ball(0.06)).items():
        assert iou(mask.hair, upper(hairy_capture.rig.camera(name))[1]) > 0.93


def test_the_users_mask_wins(shoot: Callable[..., Capture]) -> None:
    capture = shoot(sweep=False)
    (capture.path / "masks").mkdir()
    image = np.zeros((64, 64), np.uint8)
    image[10:30, 20:40] = 255
    cv2.imwrite(str(capture.path / "masks" / "left.png"), image)
    masks = hair_masks(capture, None, ball(0.1))
    assert masks["left"].source == "user"
    assert np.array_equal(masks["left"].hair, image > 0)
    assert masks["right"].source == "geometry alone"


def test_a_head_without_lights_or_points_does_not_separate_hair_from_skin(
    shoot: Callable[..., Capture],
) -> None:
    """A head a pixel inside the outline: what is beyond it is hair, and all within follows."""
    capture = shoot(sweep=False)
    masks = hair_masks(capture, None, ball(0.09))
    usable_masks(capture, masks, stage := Stage("masks"))
    assert masks["left"].hair.sum() == masks["left"].subject.sum()
    (said,) = stage.warnings
    assert "could not be separated on the head" in said


def test_with_nothing_to_go_by_all_of_the_subject_may_be_hair(sphere_capture: Capture) -> None:
    masks = hair_masks(sphere_capture)
    mask = masks["left"]
    assert mask.source == "silhouette"
    assert mask.decided == 0
    assert np.array_equal(mask.hair, mask.subject)
    usable_masks(sphere_capture, masks, stage := Stage("masks"))
    (said,) = stage.warnings
    assert "the whole subject counts as hair" in said
    masks["left"] = replace(mask, source="user")
    usable_masks(sphere_capture, masks, stage := Stage("masks"))
    (said,) = stage.warnings
    assert "separated in right: the whole subject" in said
    masks["right"] = replace(masks["right"], source="geometry")
    usable_masks(sphere_capture, masks, stage := Stage("masks"))
    assert stage.warnings == []


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
    (capture.path / "subjects").mkdir()
    cv2.imwrite(str(capture.path / "subjects" / "left.png"), np.full((64, 64), 255, np.uint8))
    assert hair_masks(capture) == {}  # an outline alone shows no hair


def test_distances_to_a_ball() -> None:
    points = np.array([[0.105, 0, 0], [0, 0.095, 0], [0, 0, 0.15]])
    found = distance_to(ball(0.1, 60), points)
    assert found == pytest.approx([0.005, -0.005, 0.05], abs=3e-4)


def test_the_head_covers_its_outline(stage_camera: Callable[..., Camera]) -> None:
    device = stage_camera("c", 0.0)
    assert iou(np.isfinite(mesh_depth(device, ball(0.1, 40))), upper(device)[0]) > 0.93


def looks_of(gloss: float, colour: float, count: int, seed: int) -> np.ndarray:
    """Looks `(count, 4)` about a gloss and a log ratio of red to green; the rest says nothing."""
    rng = np.random.default_rng(seed)
    middle = [np.log(gloss + 0.03), colour, 0.3, -1.0]
    return np.asarray(middle + rng.normal(size=(count, 4)) * [0.3, 0.08, 0.08, 0.2])


@pytest.mark.parametrize("colour", [0.4, 0.0])
def test_flat_hair_is_found_by_colour_and_without_it_by_gloss(colour: float) -> None:
    sure, flat = looks_of(0.25, colour, 500, 0), looks_of(0.25, colour, 300, 1)
    skin = looks_of(0.04, 0.0, 600, 2)
    known = np.arange(1400) < 500
    odds = two_classes(np.concatenate([sure, flat, skin]), known).scores
    assert (odds(flat.T) > 0).mean() > 0.95
    assert (odds(skin.T) < 0).mean() > 0.95


def test_flat_hair_that_is_partly_matte_does_not_blur_the_colours() -> None:
    sure, flat, skin = (
        looks_of(*a) for a in ((0.3, 0.5, 500, 0), (0.3, 0.5, 400, 1), (0.04, 0, 100, 2))
    )
    known = np.arange(1000) < 500
    odds = two_classes(np.concatenate([sure, flat, skin]), known).scores
    assert (odds(flat.T) > 0).mean() > 0.99
    assert (odds(skin.T) < 0).mean() > 0.99


def test_cloth_of_the_colour_of_hair_is_separated_by_gloss_and_skin_by_colour() -> None:
    hair, cloth, skin = (
        looks_of(*a) for a in ((0.2, 0.5, 1500, 0), (0.05, 0.5, 900, 1), (0.1, 0.0, 400, 2))
    )
    everything = np.concatenate([hair, cloth, skin])
    found = clear_classes(everything)
    assert found is not None
    assert (found.scores(hair.T) > 0).mean() > 0.93
    assert (found.scores(cloth.T) < 0).mean() > 0.93
    assert (found.scores(skin.T) < 0).mean() > 0.99
    assert clear_classes(np.concatenate([hair, cloth]), measured=False) is None


def test_a_single_class_is_not_split() -> None:
    known = np.arange(1000) < 500
    covered = looks_of(0.25, 0.0, 1000, 0)
    assert (two_classes(covered, known).scores(covered.T) > 0).all()
    matte = looks_of(0.04, 0.0, 1000, 0)  # what stands off is no hair: a misplaced head
    assert (two_classes(matte, known).scores(matte.T) < 0).all()


@pytest.mark.parametrize("share", [0.4, 0.05])
def test_hair_and_skin_of_two_colours_need_no_example(share: float) -> None:
    count = round(2000 * share)
    hair, skin = looks_of(0.25, 0.5, 2000 - count, 0), looks_of(0.1, 0.0, count, 1)
    classes = clear_classes(np.concatenate([hair, skin]))
    assert classes is not None
    assert (classes.scores(hair.T) > 0).mean() > 0.98
    assert (classes.scores(skin.T) < 0).mean() > 0.98


def test_hair_alone_of_which_some_shines_more_is_one_class() -> None:
    assert clear_classes(looks_of(0.25, 0.0, 2000, 0)) is None
    rim, inner = looks_of(0.37, 0.45, 700, 0), looks_of(0.24, 0.6, 1300, 1)
    assert clear_classes(np.concatenate([rim, inner])) is None
    alike = np.concatenate([looks_of(0.12, 0.0, 1000, 0), looks_of(0.05, 0.0, 1000, 1)])
    assert clear_classes(alike) is None
    assert clear_classes(looks_of(0.25, 0.0, 5, 0)) is None


def test_hair_at_the_outline_that_shines_more_does_not_make_the_rest_skin() -> None:
    """Looks of the demo's hair: its rim is brighter and less red than what lies on the head."""
    rng = np.random.default_rng(3)

    def some(count: int, middle: list[float], spread: list[float]) -> np.ndarray:
        middle[0] = np.log(middle[0] + 0.03)
        return np.asarray(middle + rng.normal(size=(count, 4)) * spread)

    rim = some(2400, [0.35, 0.45, 0.63, -2.3], [0.32, 0.12, 0.12, 0.5])
    inner = some(5200, [0.28, 0.63, 0.75, -3.5], [0.32, 0.08, 0.08, 0.4])
    skin = some(1280, [0.14, 0.4, 0.24, -2.6], [0.4, 0.05, 0.07, 0.2])
    scores = two_classes(np.concatenate([rim, inner, skin]), np.arange(8880) < 2400).scores
    assert (scores(inner.T) > 0).mean() > 0.97
    assert (scores(skin.T) < 0).mean() > 0.97


@pytest.mark.parametrize("size", [64, 400])
def test_finer_pictures_do_not_take_the_rim_of_a_head_that_is_too_small_for_hair(
    shoot: Callable[..., Capture], stage_camera: Callable[..., Camera], size: int
) -> None:
    """A millimetre too small, which is four pixels of the finer camera."""
    camera = stage_camera("c", -40, size=size)
    capture = shoot(cameras=[camera], lights=LIGHTS[::3], extra=hairy, sweep=False, samples=1)
    mask = hair_masks(capture, head=ball(0.99 * RADIUS, n=64))["c"]
    subject, hair = upper(camera)
    assert mask.hair[hair].mean() > 0.7
    assert mask.hair[subject & ~hair].mean() < 0.02
