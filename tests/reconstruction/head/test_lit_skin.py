"""A face that single lights show: normals, their integral, and the head that is laid under it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import cKDTree

from reconstruction import (
    Camera,
    Capture,
    CaptureError,
    Light,
    Mesh,
    Model,
    Report,
    Rig,
    Stage,
    read_obj,
    silent,
)
from reconstruction.geometry.closest_point import ClosestPoint
from reconstruction.geometry.lights import dome_positions
from reconstruction.geometry.mesh_queries import mesh_depth, surface_samples
from reconstruction.head.capture_head import fit_capture_head, lit_skin_points
from reconstruction.head.generic import generic_head
from reconstruction.head.heads import Heads
from reconstruction.head.lit_skin import integrated, lit_skin, matte_normals
from reconstruction.masks import HairMask, MaskedCapture
from reconstruction.reconstruct_options import ReconstructOptions

LIGHTS = tuple(
    Light(f"l{i:02d}", p, np.full(3, 2.0)) for i, p in enumerate(dome_positions(60, 1.2, -40.0))
)
HAIR = 0.015


def unit(v: np.ndarray) -> np.ndarray:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def test_normals_stand_against_shadows_and_highlights_and_near_lights() -> None:
    rng = np.random.default_rng(0)
    normals = unit(rng.normal(size=(300, 3)) * 0.6 - [0, 1, 0])
    places = dome_positions(60, 1.2, -60.0)
    to_light = places - rng.uniform(-0.1, 0.1, (300, 1, 3))
    square = (to_light**2).sum(axis=2)
    matte = 0.4 * np.maximum(np.einsum("ni,nli->nl", normals, unit(to_light)), 0) / square
    values = matte * np.where(rng.random(matte.shape) < 0.25, 0.1, 1.0)
    values += matte.max() * (rng.random(matte.shape) < 0.03)
    found = matte_normals(values, to_light)
    angles = np.degrees(np.arccos(np.clip((found * normals).sum(axis=1), -1, 1)))
    assert np.quantile(angles, 0.95) < 0.1
    cut = np.minimum(matte, 0.2)  # where the sensor is full
    known = matte_normals(cut, to_light, matte < 0.2)
    angles = np.degrees(np.arccos(np.clip((known * normals).sum(axis=1), -1, 1)))
    assert np.quantile(angles, 0.95) < 0.1
    assert not matte_normals(np.zeros((2, 60)), to_light[:2]).any()


def test_the_integral_of_a_ball_is_the_ball_and_two_balls_are_two_pieces() -> None:
    camera = Camera.look_at("c", 90, 90, (0, -1, 0), (0, 0, 0), 14.0)
    rays = camera.rays(np.stack(np.meshgrid(np.arange(90), np.arange(90)), axis=-1))

    def ball(center: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        away = camera.center - center
        b = rays @ away
        square = b**2 - away @ away + radius**2
        point = camera.center + (-b - np.sqrt(np.maximum(square, 0)))[..., None] * rays
        return square > 0, (point - camera.center) @ camera.R[2], unit(point - center)

    one, depth, normals = ball(np.zeros(3), 0.09)
    facing = one & ((normals * -rays).sum(axis=-1) > 0.4)
    log_depth, piece = integrated(camera, facing, normals[facing])
    assert np.ptp(log_depth - np.log(depth[facing])) < 1.7e-4  # of 1 m: the ball is 55 mm deep
    assert len(np.unique(piece)) == 1
    behind, _, far = ball(np.array([0.04, 0.3, 0.05]), 0.12)
    both = one | behind
    every = np.where(one[..., None], normals, far)
    _, piece = integrated(camera, both, every[both])
    image = np.full(both.shape, -1)
    image[both] = piece
    assert image[45, 45] != image[20, 75]
    assert (np.bincount(piece) > 300).sum() == 2


@pytest.fixture(scope="module")
def head() -> Mesh:
    whole = generic_head()
    return Mesh(1.04 * whole.vertices + [0.005, 0.0, 0.01], whole.faces, whole.scalp)


class Shaded(Capture):
    """A matte head under hair of `HAIR` metres; only what `lit_skin` asks is there."""

    def __init__(self, head: Mesh, cameras: list[Camera], lights: tuple[Light, ...]) -> None:
        self.path, self.rig = Path("shaded"), Rig("shaded", tuple(cameras), lights)
        points, normals, face = surface_samples(head, 2e-3)
        tree, self.masks, self._views = cKDTree(points), {}, {}
        thick = points[head.scalp[face]]
        thick = np.concatenate([thick + h * normals[head.scalp[face]] for h in (0.5 * HAIR, HAIR)])
        for camera in cameras:
            depth = mesh_depth(camera, head)
            y, x = np.nonzero(np.isfinite(depth))
            rays = camera.rays(np.stack([x, y], axis=1))
            at = camera.center + rays * (depth[y, x] / (rays @ camera.R[2]))[:, None]
            near = tree.query(at)[1]
            hair, skin = np.zeros((2, camera.height, camera.width), bool)
            visible, column, row, far = camera.pixels_of(thick)
            before = far <= depth[row, column]
            hair[row[visible & before], column[visible & before]] = True
            hair = ndimage.binary_closing(hair, iterations=2)
            skin[y, x] = ~head.scalp[face[near]]
            self.masks[camera.name] = HairMask(hair | skin, hair, skin & ~hair, "user", 1.0)
            self._views[camera.name] = y, x, at, normals[near]

    def olat_lights(self) -> list[str]:
        return [light.name for light in self.rig.lights]

    def has_light(self, light: str, camera: str) -> bool:
        return True

    def light(self, light: str, camera: str) -> Any:
        y, x, at, normals = self._views[camera]
        device, lamp = self.rig.camera(camera), self.rig.light(light)
        away = lamp.position - at
        square = (away**2).sum(axis=1)
        image = np.zeros((device.height, device.width, 3), np.float32)
        lit = 2.0 * np.maximum((normals * unit(away)).sum(axis=1), 0) / square
        image[y, x] = 0.3 * lit[:, None]
        return image, np.zeros(image.shape[:2], bool)


def around(size: int) -> list[Camera]:
    places = [(1.2 * np.sin(a), -1.2 * np.cos(a), 0.1) for a in np.radians(np.arange(8) * 45.0)]
    return [Camera.look_at(f"c{k}", size, size, p, (0, 0, 0), 18.0) for k, p in enumerate(places)]


@pytest.mark.parametrize("size", [160, pytest.param(400, marks=pytest.mark.slow)])
def test_a_head_is_fitted_to_the_lit_face(head: Mesh, size: int) -> None:
    """Finer pixels than the hull's voxels are averaged, and find the same."""
    capture = Shaded(head, around(size), LIGHTS)
    masked = MaskedCapture(capture, capture.masks)
    found = lit_skin_points(masked, masked.subject_hull(3e-3))
    assert found.source in [f"skin under single lights, c{k}" for k in (0, 1, 7)]  # in front
    assert found.hints.turn == pytest.approx(0, abs=0.8)
    apart = ClosestPoint(head, 8e-3)(found.points)[2]
    assert np.median(apart) < 2e-3
    fitted = fit_capture_head(found, None, Stage("head")).mesh
    scalp = head.vertices[np.unique(head.faces[head.scalp])]
    assert np.median(ClosestPoint(fitted, 8e-3)(scalp)[2]) < 2e-3


@pytest.mark.slow
def test_a_lamp_that_gives_no_light_does_not_move_the_head(head: Mesh) -> None:
    """Its frames hold noise; the head is where it is without them."""

    class OneDark(Shaded):
        def light(self, light: str, camera: str) -> Any:
            image, saturated = super().light(light, camera)
            noise = np.random.default_rng(int(light[1:])).normal(0, 1e-3, image.shape)
            return (noise + (image if light != dark.name else 0)).astype(np.float32), saturated

    dark = Light(LIGHTS[7].name, LIGHTS[7].position, np.zeros(3))
    capture = OneDark(head, around(120), (*LIGHTS[:7], dark, *LIGHTS[8:]))
    masked = MaskedCapture(capture, capture.masks)
    found = lit_skin_points(masked, masked.subject_hull(3e-3))
    assert np.median(ClosestPoint(head, 8e-3)(found.points)[2]) < 2e-3


@pytest.mark.slow
def test_a_hull_takes_the_head_and_none_from_a_face_unlike_the_template(
    head: Mesh, tmp_path: Path
) -> None:
    def found(mesh: Mesh) -> tuple[Any, Stage]:
        capture, report = Shaded(mesh, around(160), LIGHTS), Report()
        heads = Heads(Model(tmp_path), ReconstructOptions(grid=3e-3), silent, report)
        return heads.fit_by_shading(MaskedCapture(capture, capture.masks)), report.stages[-1]

    mine, stage = found(head)
    assert mine is not None
    assert not stage.warnings
    assert read_obj(tmp_path / "head.obj").vertices.shape == mine.mesh.vertices.shape
    flat = Mesh(head.vertices * [1.0, 0.6, 1.0], head.faces, head.scalp)
    none, stage = found(flat)
    assert none is None
    assert "RMS from the template, limit 3 mm; provide head.obj" in stage.warnings[-1]
    assert not (tmp_path / "head.obj").exists()


@pytest.mark.slow
def test_few_lights_or_little_skin_give_no_points(head: Mesh) -> None:
    few = Shaded(head, around(120), LIGHTS[:20])
    masked = MaskedCapture(few, few.masks)
    with pytest.raises(CaptureError, match="24 single lights"):
        lit_skin_points(masked, masked.subject_hull(3e-3))
    capture = Shaded(head, around(120), LIGHTS)
    camera, hull = capture.rig.cameras[0], masked.subject_hull(3e-3)
    spot = capture.masks[camera.name].skin.copy()
    spot[:, :57] = False
    spot[:, 63:] = False
    assert lit_skin(capture, camera, spot, hull) is None
    assert lit_skin(capture, camera, spot & False, hull) is None
    above = float(head.vertices[:, 2].max()) + 1.0
    assert lit_skin(capture, camera, capture.masks[camera.name].skin, hull, above) is None
