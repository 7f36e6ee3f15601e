"""Lines from planes that cross at known angles."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from reconstruction import Camera, Capture, Light
from reconstruction.capture_scale import CaptureScale
from reconstruction.geometry.lights import dome_positions
from reconstruction.light_planes import PointCloud
from reconstruction.masks import HairMask, MaskedCapture
from reconstruction.reconstruct_options import MeasureOptions
from reconstruction.tangents.estimate import Measured, measure_tangents
from reconstruction.tangents.line_evidence import LineEvidence, condition_lines

UP = np.array([0.0, 0.0, 1.0])
BINS = 36


def around(azimuth_deg: float) -> Camera:
    a = np.radians(azimuth_deg)
    return Camera.look_at("c", 64, 64, (np.sin(a), -np.cos(a), 0.0), (0, 0, 0), 20.0)


def sees(
    camera: Camera, direction: np.ndarray, contrast: float = 1.0, points: tuple[int, ...] = (0,)
) -> LineEvidence:
    """Of points at the origin, a view of those whose numbers are given: each shows a line in the
    direction's image."""
    a, b = camera.project(np.stack([-1e-4 * direction, 1e-4 * direction]))[0]
    own = np.arctan2(*(b - a)[::-1])
    peak = np.cos(np.arange(BINS) * np.pi / BINS - own) ** 20
    support = contrast * (peak / peak.mean() - 1)
    whole = np.broadcast_to(support, (len(points), BINS)).astype(np.float32)
    return LineEvidence(camera, np.array(points, int), np.full((len(points), 2), 31.5), whole)


@pytest.mark.parametrize("degrees", [2.0, 10.0, 45.0, 90.0])
def test_the_spread_of_two_planes_is_the_tangent_of_half_their_angle(degrees: float) -> None:
    views = [sees(around(0.0), UP), sees(around(degrees), UP)]
    found = condition_lines(views, 1)
    assert found.views[0] == 2
    assert found.spread[0] == pytest.approx(np.tan(np.radians(degrees) / 2), rel=1e-3)
    assert found.misfit[0] < 1e-3  # two planes always meet in a line
    assert found.figures()["undetermined_share"] == float(degrees < 11)


def test_one_view_and_none_determine_nothing() -> None:
    views = [sees(around(0.0), UP, points=(0, 2)), sees(around(60.0), UP, points=(2,))]
    found = condition_lines(views, 3)
    assert found.views.tolist() == [1, 0, 2]
    assert found.spread[:2].tolist() == [0, 0]
    assert not found.misfit[:2].any()
    figures = found.figures()
    assert figures["views_per_point"] == {"0": 1, "1": 1, "2": 1}
    assert figures["undetermined_share"] == pytest.approx(2 / 3)
    json.dumps(figures, allow_nan=False)


def test_views_that_disagree_are_a_misfit() -> None:
    tilted = np.array([0.3, 0.0, 1.0]) / np.linalg.norm([0.3, 0, 1])
    good = [sees(around(a), UP) for a in (0, 45, 90)]
    bad = [*good[:2], sees(around(90), UP), sees(around(0), tilted)]
    agree = condition_lines(good, 1).misfit[0]
    differ = condition_lines(bad, 1).misfit[0]
    assert agree < 1e-3
    assert differ > 0.1


def test_a_view_without_texture_does_not_count_and_a_weak_one_counts_less() -> None:
    flat = sees(around(90), UP, contrast=0.0)
    alone = condition_lines([sees(around(0), UP), flat], 1)
    assert alone.views[0] == 1
    assert alone.spread[0] == 0
    weak = condition_lines([sees(around(0), UP), sees(around(90), UP, 0.3)], 1)
    assert weak.spread[0] == pytest.approx(np.sqrt(0.3), rel=1e-3)


def test_no_points_are_no_trouble() -> None:
    found = condition_lines([sees(around(0), UP, points=())], 0)
    assert len(found.spread) == 0
    json.dumps(found.figures(), allow_nan=False)


def meridians(lights: list[Light], stripes: int) -> Callable[..., np.ndarray]:
    """Draws a sphere of 10 cm with stripes along its meridians."""

    def draw(step: dict[str, object], camera: Camera) -> np.ndarray:
        grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
        rays = camera.rays(grid)
        b = rays @ camera.center
        inside = b**2 - (camera.center @ camera.center - 0.01)
        p = camera.center + (-b - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
        azimuth = np.arctan2(p[..., 1], p[..., 0])
        shade = p @ next(x for x in lights if x.name == step["light"]).position
        bright = (1.2 + np.cos(stripes * azimuth)) * (0.05 + np.maximum(shade, 0))
        return np.where(inside > 0, bright, 0.0)

    return draw


def on_sphere(z: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Points of that sphere at the heights and azimuths of a grid."""
    z, a = (v.ravel() for v in np.meshgrid(z, a))
    r = np.sqrt(0.01 - z**2)
    return np.stack([r * np.sin(a), -r * np.cos(a), z], axis=1)


def off_meridians(found: Measured) -> float:
    """Median degrees between measured directions and the meridians."""
    n = found.points / np.linalg.norm(found.points, axis=1, keepdims=True)
    t = UP - n[:, 2:] * n
    t /= np.linalg.norm(t, axis=1, keepdims=True)
    cosine = np.abs((found.directions * t).sum(axis=1)).clip(0, 1)
    return float(np.median(np.degrees(np.arccos(cosine))))


@dataclass(frozen=True)
class Stage:
    """Cameras at some azimuths before the sphere, and its frames."""

    cameras: list[Camera]
    masked: MaskedCapture

    @classmethod
    def of(
        cls,
        shoot: Callable[..., Capture],
        stage_camera: Callable[..., Camera],
        count: int,
        azimuths: tuple[int, ...],
        size: int = 80,
    ) -> Stage:
        places = enumerate(dome_positions(count, 1.2, 0.0))
        lights = [Light(f"l{i}", p, np.ones(3)) for i, p in places]
        cameras = [stage_camera(f"c{a}", a, 0.0, size=size) for a in azimuths]
        draw = meridians(lights, size // 2)
        capture = shoot(cameras=cameras, projectors=[], lights=lights, extra=draw, samples=1)
        whole = np.ones((size, size), bool)
        masks = {c.name: HairMask(whole, whole, ~whole, "user", 1.0) for c in cameras}
        return cls(cameras, MaskedCapture(capture, masks))

    def measured(self, cloud: PointCloud, options: MeasureOptions) -> Measured:
        depths = {c.name: np.full((c.height, c.width), 0.85) for c in self.cameras}
        scale = replace(CaptureScale.of(self.cameras, cloud.points), tolerance=0.1)
        return measure_tangents(self.masked, cloud, depths, scale, options)


@pytest.mark.parametrize("count", [1, 8, 30], ids=["one light", "each light", "groups"])
def test_orientations_come_from_each_light_or_from_groups(
    shoot: Callable[..., Capture],
    stage_camera: Callable[..., Camera],
    cloud_of: Callable[..., PointCloud],
    count: int,
) -> None:
    stage = Stage.of(shoot, stage_camera, count, (-40, 0, 40))
    points = on_sphere(np.linspace(-0.05, 0.05, 9), np.linspace(-0.6, 0.6, 9))
    cloud = cloud_of(points, np.zeros(len(points)), [c.name for c in stage.cameras])
    assert off_meridians(stage.measured(cloud, MeasureOptions())) < 8


def test_points_of_a_sweep_give_the_slope_that_cameras_side_by_side_do_not(
    shoot: Callable[..., Capture],
    stage_camera: Callable[..., Camera],
    cloud_of: Callable[..., PointCloud],
) -> None:
    stage = Stage.of(shoot, stage_camera, 1, (-2, 2), 240)
    points = on_sphere(np.arange(0.045, 0.08, 1e-3), np.arange(-0.4, 0.4, 0.015))
    cloud = cloud_of(points, np.arange(len(points)) % 2, [c.name for c in stage.cameras])
    texture = off_meridians(stage.measured(cloud, MeasureOptions(line_weight=0.0)))
    assert texture > 30  # across the views, whatever the slope
    assert off_meridians(stage.measured(cloud, MeasureOptions())) < 15  # candidates are 7 apart
