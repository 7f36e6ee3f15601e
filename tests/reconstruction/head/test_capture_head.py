"""A capture without a head gets one: under digitised points, or under the skin that was seen."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reconstruction import (
    Camera,
    Capture,
    CaptureError,
    Mesh,
    Model,
    Stage,
    Strands,
    read_obj,
    write_obj,
)
from reconstruction.geometry.closest_point import ClosestPoint
from reconstruction.geometry.mesh_queries import surface_samples
from reconstruction.head.capture_head import (
    FEWEST_SKIN,
    digitised_points,
    fit_capture_head,
    skin_points,
)
from reconstruction.head.fit import HeadFitError
from reconstruction.head.generic import generic_head
from reconstruction.head.scalp import find_scalp, sample_roots
from reconstruction.head.scalp_map import ScalpMap, write_root_map
from reconstruction.head.template import template
from reconstruction.light_planes import PointCloud
from reconstruction.masks import HairMask, MaskedCapture

SCALE, SHIFT = 1.06, np.array([0.01, -0.005, 0.02])


@pytest.fixture
def capture(shoot: Callable[..., Capture], stage_camera: Callable[..., Camera]) -> Capture:
    """Four cameras around a head; nothing here looks at their pictures."""
    cameras = [stage_camera(f"c{a}", a, 5.0, size=120) for a in (-60, 0, 60, 180)]
    return shoot(cameras=cameras, projectors=[], samples=1)


def the_head(turn_deg: float = 0.0) -> Mesh:
    """The subject's: the generic one, larger, longer, turned and elsewhere."""
    v = generic_head().vertices * [1.0, 1.0, 1.04]
    mesh = Mesh(SCALE * v, generic_head().faces, generic_head().scalp)
    return mesh.transformed(Rotation.from_euler("z", turn_deg, degrees=True).as_matrix(), SHIFT)


def off(mesh: Mesh, turn_deg: float = 0.0) -> np.ndarray:
    """Millimetres from the true scalp's vertices to `mesh`."""
    truth = the_head(turn_deg)
    return 1e3 * ClosestPoint(mesh, 8e-3)(truth.vertices[np.unique(truth.faces[truth.scalp])])[2]


def cloud_of(capture: Capture, turn_deg: float = 0.0) -> tuple[PointCloud, dict[str, HairMask]]:
    """Points on skin, and on hair 1 cm above the scalp, as the cameras see them, with masks.

    The skin goes on over the shoulders.
    """
    truth, rng = the_head(turn_deg), np.random.default_rng(0)
    p, n, face = surface_samples(truth, 3e-3)
    scalp = truth.scalp[face]
    shoulders = rng.uniform([-0.12, -0.1, -0.16], [0.12, 0.1, -0.15], (4000, 3))
    p, scalp = np.concatenate([p, shoulders]), np.concatenate([scalp, np.zeros(4000, bool)])
    n = np.concatenate([n, np.tile([0, -0.4, 0.9], (4000, 1))])
    p = p + 0.01 * scalp[:, None] * n + 3e-4 * rng.standard_normal(p.shape)
    masks, columns = {}, []
    for k, camera in enumerate(capture.rig.cameras):
        view = camera.center - p
        view /= np.linalg.norm(view, axis=1, keepdims=True)
        inside = camera.inside(camera.project(p)[0])
        visible = inside & ((view * n).sum(axis=1) > 0.3)
        pixels = np.rint(camera.project(p)[0]).astype(int)
        hair, skin = np.zeros((2, camera.height, camera.width), bool)
        hair[tuple(pixels[visible & scalp].T[::-1])] = True
        skin[tuple(pixels[visible & ~scalp].T[::-1])] = True
        masks[camera.name] = HairMask(hair | skin, hair, skin & ~hair, "reflectance", 1.0)
        columns.append((p[visible], view[visible], pixels[visible], np.full(visible.sum(), k)))
    points, view, pixel, camera_of = (np.concatenate(c) for c in zip(*columns, strict=True))
    count, zero = len(points), np.zeros(len(points))
    cloud = PointCloud(
        points,
        np.tile(1e-8 * np.eye(3), (count, 1, 1)),
        view,
        pixel,
        camera_of,
        zero,
        zero,
        zero,
        zero,
        zero + 1,
        tuple(c.name for c in capture.rig.cameras),
        ("p",),
    )
    return cloud, masks


def test_a_head_is_fitted_to_digitised_scalp_points(capture: Capture) -> None:
    truth = the_head()
    points, _, face = surface_samples(truth, 8e-3)
    on = truth.scalp[face]
    write_obj(capture.path / "scalp.obj", Mesh(points[on], np.zeros((0, 3))))
    known = digitised_points(capture, None)
    assert known is not None
    assert known.hints.part == "scalp"
    stage = Stage("head")
    fitted = fit_capture_head(known, None, stage)
    assert np.median(off(fitted.mesh)) < 0.5
    assert stage.figures["source"] == "scalp.obj"
    assert stage.figures["rms_mm"] < 0.6
    assert stage.figures["used_share"] > 0.95


@pytest.mark.parametrize("turn_deg", [pytest.param(0.0, marks=pytest.mark.slow), 35.0])
def test_a_head_is_fitted_to_observed_skin(capture: Capture, turn_deg: float) -> None:
    cloud, masks = cloud_of(capture, turn_deg)
    skin = skin_points(MaskedCapture(capture, masks), cloud)
    assert skin.hints.turn == pytest.approx(np.radians(turn_deg), abs=np.radians(30))
    apart = ClosestPoint(the_head(turn_deg), 8e-3)(skin.points)[2]
    assert np.percentile(apart, 95) < 2e-3
    assert skin.normals is not None
    stage = Stage("head")
    fitted = fit_capture_head(skin, None, stage, cloud=cloud)
    assert np.median(off(fitted.mesh, turn_deg)) < 3.0
    assert stage.figures["cloud_inside_share"] < 0.05
    assert stage.warnings == []


def test_too_little_skin_says_what_to_give(capture: Capture) -> None:
    cloud, masks = cloud_of(capture)
    all_hair = {
        k: HairMask(m.subject, m.subject, m.subject & False, "silhouette", 0.0)
        for k, m in masks.items()
    }
    words = rf"no head\.obj, .* in only 0 cells.*expected {FEWEST_SKIN}.*option scalp_points"
    with pytest.raises(CaptureError, match=words):
        skin_points(MaskedCapture(capture, all_hair), cloud)
    empty = PointCloud.empty(cloud.cameras, cloud.projectors)
    with pytest.raises(CaptureError, match="nor a sweep to fit a head to"):
        skin_points(MaskedCapture(capture, masks), empty)


def test_points_that_are_no_head_are_a_capture_error(capture: Capture, tmp_path: Path) -> None:
    np.save(tmp_path / "scalp.npy", np.random.default_rng(0).random((50, 3)) * 1e3)
    known = digitised_points(capture, tmp_path / "scalp.npy")
    assert known is not None
    with pytest.raises(CaptureError, match=r"no head could be fitted to scalp\.npy.*millimetres"):
        fit_capture_head(known, None, Stage("head"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "above"), [("lee_perry_smith.obj", None), ("makehuman_base.obj", 6.0)]
)
def test_the_users_head_is_a_template(
    file: str,
    above: float | None,
    shared_data: Callable[[str], Path],
    capture: Capture,
    tmp_path: Path,
) -> None:
    own, fit = template(read_obj(shared_data("heads") / file), up="y", above=above)
    assert fit is not None
    assert 0.2 < np.ptp(own.vertices, axis=0).max() < 0.45  # metres
    middle, area = own.vertices[own.faces].mean(axis=1), own.face_areas()
    above_and_behind = (
        np.average(middle[own.scalp], axis=0, weights=area[own.scalp])
        - np.average(middle[~own.scalp], axis=0, weights=area[~own.scalp])
    )[1:]
    assert (above_and_behind > 0.01).all()
    write_obj(tmp_path / "own.obj", own)
    points, normals, face = surface_samples(the_head(), 6e-3)
    known = digitised_points(capture, None)
    assert known is None
    on = the_head().scalp[face]
    np.save(tmp_path / "scalp.npy", np.hstack([points[on], normals[on]]))
    known = digitised_points(capture, tmp_path / "scalp.npy")
    assert known is not None
    stage = Stage("head")
    fitted = fit_capture_head(known, tmp_path / "own.obj", stage)
    assert stage.figures["template"] == "own.obj"
    assert np.median(off(fitted.mesh)) < 1.0
    roots, _ = sample_roots(find_scalp(fitted.mesh), 500, seed=0)
    assert fitted.scalp_map is not None
    uv, distance = fitted.scalp_map(roots)
    assert distance.max() < 1e-3
    assert np.ptp(uv, axis=0).min() > 0.9


def test_a_mesh_that_is_no_head_is_refused() -> None:
    with pytest.raises(HeadFitError, match="entirely above 9"):
        template(generic_head(), above=9.0)
    marked, fit = template(generic_head())
    assert fit is None
    assert marked.scalp is not None


def test_roots_are_written_with_their_place_on_the_scalp(tmp_path: Path) -> None:
    scalp = find_scalp(generic_head())
    roots, normals = sample_roots(scalp, 40, seed=1)
    strands = Strands.from_list(
        [np.stack([r, r + 0.01 * n]) for r, n in zip(roots, normals, strict=True)]
    )
    stage = Stage("strands")
    write_root_map(Model(tmp_path), strands, scalp, None, stage)
    with np.load(tmp_path / "scalp_map.npz") as data:
        np.testing.assert_allclose(data["roots"], ScalpMap.of(generic_head())(roots)[0], atol=1e-4)
        assert data["uv"].shape == (len(data["vertices"]), 2)
        assert data["faces"].max() == len(data["vertices"]) - 1
        assert all(np.isfinite(data[k]).all() for k in data.files)
    assert stage.figures["roots_off_the_map_mm"] < 0.01
    # a scalp all around the head cannot be laid flat
    whole = generic_head()
    whole = Mesh(whole.vertices, whole.faces, np.ones(len(whole.faces), bool))
    write_root_map(Model(tmp_path), strands, find_scalp(whole), None, stage)
    assert any("no scalp_map.npz: the map of the scalp folds" in w for w in stage.warnings)
    assert not (tmp_path / "scalp_map.npz").exists()
