"""Captures of a sphere whose hair runs down from its top, from frames to strands."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from reconstruction import (
    Camera,
    Capture,
    CaptureError,
    Light,
    Mesh,
    Model,
    ReconstructOptions,
    Report,
    Strands,
    read_strands,
    reconstruct,
    write_obj,
)
from reconstruction.estimate import estimate
from reconstruction.geometry.lights import dome_positions
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.growing import GrowingStages
from reconstruction.growth.field import solve_field
from reconstruction.head.scalp import find_scalp
from reconstruction.light_codes.segments import Segments
from reconstruction.light_planes import PointCloud
from reconstruction.reconstruct_options import MeasureOptions
from reconstruction.report.report import silent
from reconstruction.tangents.estimate import Measured, light_groups, thinned

RADIUS, HEAD = 0.1, 0.09
LIGHTS = [Light(f"l{i}", p, np.ones(3)) for i, p in enumerate(dome_positions(12, 1.2, 0.0))]
QUICK = ReconstructOptions(grid=5e-3, roots=150, max_length=0.12)
COARSE = ReconstructOptions(grid=8e-3, roots=100, max_length=0.1, measure=MeasureOptions(thin=8e-3))


def ball(radius: float) -> Mesh:
    """A closed sphere whose upper half is marked as scalp."""
    rows, columns = 24, 48
    theta, phi = np.linspace(0, np.pi, rows + 1), np.arange(columns) * 2 * np.pi / columns
    t, p = (a.ravel() for a in np.meshgrid(theta, phi, indexing="ij"))
    vertices = radius * np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=1)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    a, b = i * columns + j, i * columns + (j + 1) % columns
    faces = np.concatenate(
        [np.stack([a, a + columns, b], axis=1), np.stack([b, a + columns, b + columns], axis=1)]
    )
    return Mesh(vertices, faces, vertices[faces][:, :, 2].mean(axis=1) > 0)


def down(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Unit tangents of the meridians at `points (N, 3)`."""
    n = points / np.linalg.norm(points, axis=1, keepdims=True)
    t = np.array([0, 0, 1.0]) - n[:, 2:] * n
    return np.asarray(t / np.linalg.norm(t, axis=1, keepdims=True))


def hair(step: dict[str, object], camera: Camera) -> NDArray[np.float64]:
    """Frame `(H, W)` of meridians of uneven brightness under one light."""
    sub = (np.arange(3) + 0.5) / 3 - 0.5
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    offsets = np.stack(np.meshgrid(sub, sub), axis=-1).reshape(-1, 2)
    rays = camera.rays(grid[:, :, None] + offsets)
    b = rays @ camera.center
    inside = b**2 - (camera.center @ camera.center - RADIUS**2)
    p = camera.center + (-b - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
    azimuth = np.arctan2(p[..., 1], p[..., 0])
    albedo = 1 + sum(0.25 * np.cos(k * azimuth + k) for k in (17, 29, 41))
    to = next(light for light in LIGHTS if light.name == step["light"]).position - p
    shade = (to * p).sum(axis=-1) / (np.linalg.norm(to, axis=-1) * RADIUS)
    lit = np.where(inside > 0, albedo * (0.2 + np.maximum(shade, 0)), 0)
    return np.asarray(lit.mean(axis=-1))


@pytest.fixture(scope="module")
def around(stage_camera: Callable[..., Camera]) -> list[Camera]:
    return [stage_camera(f"c{a}", a, 15.0, size=96) for a in (0, 72, 144, 216, 288)]


@pytest.fixture(scope="module")
def unswept(shoot: Callable[..., Capture], around: list[Camera]) -> Capture:
    """Five cameras around, twelve lights, no projector."""
    capture = shoot(cameras=around, projectors=[], lights=LIGHTS, extra=hair)
    write_obj(capture.path / "head.obj", ball(HEAD))
    return capture


@pytest.fixture(scope="module")
def progress_calls() -> list[tuple[str, float]]:
    """What the progress of `model` said."""
    return []


@pytest.fixture(scope="module")
def model(
    unswept: Capture,
    tmp_path_factory: pytest.TempPathFactory,
    progress_calls: list[tuple[str, float]],
) -> tuple[Path, Report]:
    folder = tmp_path_factory.mktemp("model")

    def record_progress(what: str, share: float) -> None:
        progress_calls.append((what, share))

    return folder, reconstruct(unswept, Model(folder), options=QUICK, progress=record_progress)


def test_every_file_is_written(model: tuple[Path, Report], around: list[Camera]) -> None:
    folder, report = model
    saved = Report.load(folder / "report.json").to_dict()
    assert json.dumps(saved) == json.dumps(report.to_dict())
    assert len(PointCloud.load(folder / "points.npz")) == 0
    sizes = {s: len(read_strands(folder / f"strands.{s}")) for s in ("npz", "hair", "usdc")}
    assert len(set(sizes.values())) == 1
    with np.load(folder / "scalp_map.npz") as data:
        assert len(data["roots"]) == sizes["npz"]
    for camera in around:
        for kind in ("hair", "skin"):
            image = cv2.imread(str(folder / "masks" / f"{camera.name}_{kind}.png"), 0)
            assert image is not None
            assert image.shape == (96, 96)


def runs_down(strands: Strands, within_deg: float = 5, mostly: float = 0.75) -> None:
    """Asserts that strands follow the meridians once they have risen from the scalp.

    Half of their points within `within_deg`, the share `mostly` of them within 20°.
    """
    assert len(strands) > 300
    distance = np.linalg.norm(strands.roots, axis=1)
    assert np.abs(distance - HEAD).max() < 1e-3
    radius = np.linalg.norm(strands.points, axis=1)
    outer = (radius > 0.098) & (np.abs(strands.points[:, 2]) < 0.07)
    along = (strands.tangents()[outer] * down(strands.points[outer])).sum(axis=1)
    turned = np.degrees(np.arccos(np.clip(np.abs(along), 0, 1)))
    assert np.median(turned) < within_deg
    assert (turned < 20).mean() > mostly


def test_the_progress_of_all_stages_goes_from_nothing_to_all_once(
    model: tuple[Path, Report], progress_calls: list[tuple[str, float]]
) -> None:
    shares = [share for _, share in progress_calls]
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0, 1)
    names = [s.name for s in model[1].stages]
    assert [what for what, _ in progress_calls if what in names] == names
    begun = dict(reversed(progress_calls))  # the first report of each
    assert 0.1 < begun["orientation"] < begun["strands"] < begun["refinement"] < 0.9


def test_strands_run_down_from_the_scalp(model: tuple[Path, Report]) -> None:
    runs_down(read_strands(model[0] / "strands.npz"))


@pytest.mark.slow
def test_half_as_many_pixels_a_side_give_nearly_the_same(unswept: Capture, tmp_path: Path) -> None:
    new = tmp_path / "new"
    reconstruct(unswept.view(reduced=2), Model(new), options=QUICK)
    runs_down(read_strands(new / "strands.npz"), within_deg=10, mostly=0.65)
    image = cv2.imread(str(new / "masks" / "c72_hair.png"), 0)
    assert image is not None
    assert image.shape == (96, 96)  # masks are left in the pixels of the frames


def test_an_estimate_reports_the_stages_that_take_time(
    unswept: Capture, model: tuple[Path, Report]
) -> None:
    estimated = estimate(unswept, method="light_planes", options=QUICK)
    few = unswept.view(cameras=["c0", "c72"], lights=unswept.olat_lights()[:9])
    assert estimate(few, options=QUICK).frames == 2 * len(few.steps)
    assert [s.name for s in estimated.stages] == [s.name for s in model[1].stages]
    assert estimated.frames == sum(
        unswept.has(s, c.name) for s in unswept.steps for c in unswept.rig.cameras
    )
    assert all(
        s.seconds >= 0 and 0 <= s.measured <= 1 and s.peak_gb > 0.1 for s in estimated.stages
    )


@pytest.mark.slow
def test_lenses_that_bend_lines_give_the_same_strands(
    shoot: Callable[..., Capture],
    around: list[Camera],
    model: tuple[Path, Report],
    tmp_path: Path,
) -> None:
    lenses = [replace(c, distortion=[-3.5, 6.0, 0.03, -0.03]) for c in around]
    capture = shoot(cameras=lenses, projectors=[], lights=LIGHTS, extra=hair)
    write_obj(capture.path / "head.obj", ball(HEAD))
    report = reconstruct(capture, Model(tmp_path), options=QUICK)
    assert set(report["lenses"].figures["pixels_kept"]) == {c.name for c in around}
    estimated = estimate(capture, method="light_planes", options=QUICK)
    assert [s.name for s in estimated.stages] == [s.name for s in report.stages]
    runs_down(read_strands(tmp_path / "strands.npz"))
    litres = [r["envelope"].figures["envelope_litres"] for r in (report, model[1])]
    assert litres[0] == pytest.approx(litres[1], rel=0.06)
    # masks are left in the pixels of the frames
    image = cv2.imread(str(tmp_path / "masks" / f"{around[0].name}_hair.png"), 0)
    assert image is not None
    assert image.shape == (96, 96)


def test_auto_without_head_or_sweep_fills_the_hull_along_what_is_measured(
    shoot: Callable[..., Capture], around: list[Camera], tmp_path: Path
) -> None:
    capture = shoot(cameras=around, projectors=[], lights=LIGHTS[:4], extra=hair)
    report = reconstruct(capture, Model(tmp_path), method="auto", options=COARSE)
    assert report["method"].figures == {
        "method": "hull",
        "capture_holds": "no sweep, 4 single lights, no head",
    }
    estimated = estimate(capture, options=COARSE)
    assert estimated.method == "hull"
    assert [s.name for s in estimated.stages] == [s.name for s in report.stages]
    assert any("no head" in w for w in report["envelope"].warnings)
    strands = read_strands(tmp_path / "strands.npz")
    assert len(strands) > 100
    # of the whole ball's hull: as the meridians do, upper end first
    radius = np.linalg.norm(strands.points, axis=1)
    outer = (radius > 0.09) & (np.abs(strands.points[:, 2]) < 0.07)
    along = (strands.tangents()[outer] * down(strands.points[outer])).sum(axis=1)
    assert np.median(np.degrees(np.arccos(np.clip(np.abs(along), 0, 1)))) < 12
    ends = strands.points[strands.offsets[1:] - 1]
    assert (strands.roots[:, 2] >= ends[:, 2]).all()


@pytest.mark.slow
def test_auto_with_a_head_and_with_nothing_but_masks(unswept: Capture, tmp_path: Path) -> None:
    report = reconstruct(unswept, Model(tmp_path / "head"), method="auto", options=QUICK)
    assert report["method"].figures["capture_holds"] == "no sweep, 12 single lights, a head"
    runs_down(read_strands(tmp_path / "head" / "strands.npz"))
    bare = shutil.copytree(unswept.path, tmp_path / "bare")
    (bare / "masks").mkdir()
    for camera in unswept.rig.cameras:
        made = tmp_path / "head" / "masks" / f"{camera.name}_hair.png"
        shutil.copy(made, bare / "masks" / f"{camera.name}.png")
    dark = Capture(bare)
    dark.steps = tuple(s for s in dark.steps if s.kind == "dark")
    report = reconstruct(dark, Model(tmp_path / "dark"), method="auto", options=QUICK)
    assert any("all strands are guessed" in w for w in report["line stereo"].warnings)
    estimated = estimate(dark, options=QUICK)
    assert [s.name for s in estimated.stages] == [s.name for s in report.stages]
    runs_down(read_strands(tmp_path / "dark" / "strands.npz"))


@pytest.mark.slow
def test_same_seed_same_strands(unswept: Capture, tmp_path: Path) -> None:
    folders = [tmp_path / "a", tmp_path / "b"]
    for folder in folders:
        reconstruct(unswept, Model(folder), options=COARSE)
    first, second = (read_strands(p / "strands.npz") for p in folders)
    assert len(first) > 50
    np.testing.assert_array_equal(first.points, second.points)


def test_a_sweep_is_triangulated(
    shoot: Callable[..., Capture],
    stage_camera: Callable[..., Camera],
    tmp_path: Path,
) -> None:
    cameras = [stage_camera(n, a, 10.0, size=96) for n, a in (("left", -40), ("right", 35))]
    capture = shoot(cameras=cameras, lights=LIGHTS, extra=hair)
    write_obj(capture.path / "head.obj", ball(HEAD))
    report = reconstruct(capture, Model(tmp_path), options=COARSE)
    estimated = estimate(capture, method="light_planes", options=COARSE)
    assert [s.name for s in estimated.stages] == [s.name for s in report.stages]
    assert not report["triangulation"].left_out
    assert report["motion"].seconds > 0
    points = PointCloud.load(tmp_path / "points.npz").points
    assert len(points) > 500
    assert np.median(np.abs(np.linalg.norm(points, axis=1) - RADIUS)) < 1e-3
    assert len(read_strands(tmp_path / "strands.npz")) > 20


@pytest.mark.slow
def test_a_capture_without_a_head_stands_on_digitised_scalp_points(
    shoot: Callable[..., Capture], around: list[Camera], tmp_path: Path
) -> None:
    capture = shoot(cameras=around, projectors=[], lights=LIGHTS[:4], extra=hair)
    whole = ball(HEAD)
    upper = whole.vertices[whole.vertices[:, 2] > 0]
    write_obj(capture.path / "scalp.obj", Mesh(upper, np.zeros((0, 3))))
    write_obj(tmp_path / "larger.obj", ball(1.08 * HEAD))
    options = replace(COARSE, head_mesh=str(tmp_path / "larger.obj"))
    estimated = estimate(capture, method="light_planes", options=options)
    report = reconstruct(capture, Model(tmp_path / "model"), options=options)
    assert [s.name for s in estimated.stages] == [s.name for s in report.stages]
    assert report["head"].figures["used_share"] > 0.9
    assert report["head"].figures["rms_mm"] < 0.5
    assert any("assumed to face" in w for w in report["head"].warnings)
    strands = read_strands(tmp_path / "model" / "strands.npz")
    assert np.abs(np.linalg.norm(strands.roots, axis=1) - HEAD).max() < 2e-3
    with np.load(tmp_path / "model" / "scalp_map.npz") as data:
        assert data["roots"].shape == (len(strands), 2)
    # once it has a head of its own, none is laid; what fails leaves the model its head
    write_obj(capture.path / "head.obj", ball(HEAD))
    unlit = Capture(capture.path)
    unlit.steps = tuple(s for s in unlit.steps if s.kind != "olat")
    with pytest.raises(CaptureError, match="no OLAT frames"):
        reconstruct(unlit, Model(tmp_path / "model"), options=QUICK)
    assert (tmp_path / "model" / "head.obj").is_file()
    report = reconstruct(Capture(capture.path), Model(tmp_path / "model"), options=COARSE)
    assert "head" not in [s.name for s in report.stages]
    assert not (tmp_path / "model" / "head.obj").exists()


def test_missing_inputs_raise_errors_that_name_them(
    shoot: Callable[..., Capture], around: list[Camera], unswept: Capture, tmp_path: Path
) -> None:
    bare = shoot(cameras=around[:2], projectors=[])
    with pytest.raises(CaptureError, match=r"no head\.obj"):
        reconstruct(bare, Model(tmp_path), options=QUICK)
    write_obj(bare.path / "head.obj", ball(HEAD))
    with pytest.raises(CaptureError, match="no OLAT frames"):
        reconstruct(Capture(bare.path), Model(tmp_path), options=QUICK)
    few = ReconstructOptions(held_out=("c0", "c72", "c144", "c216"))
    with pytest.raises(CaptureError, match="1 cameras are left, at least 2"):
        reconstruct(unswept, Model(tmp_path), options=few)
    with pytest.raises(CaptureError, match="1 cameras are left, at least 2"):
        estimate(unswept, options=few)
    unknown = ReconstructOptions(held_out=("c9",))
    with pytest.raises(KeyError, match="no camera 'c9'"):
        reconstruct(unswept, Model(tmp_path), options=unknown)
    with pytest.raises(KeyError, match="no camera 'c9'"):
        estimate(unswept, options=unknown)
    with pytest.raises(ValueError, match="unknown method 'guess'"):
        reconstruct(unswept, Model(tmp_path), method="guess")  # type: ignore[arg-type]


def test_an_estimate_of_no_hair_names_the_masks(
    unswept: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Capture, "mask", lambda self, name: np.zeros((96, 96), bool))
    with pytest.raises(CaptureError, match="no camera shows hair: check masks and frames"):
        estimate(unswept, options=QUICK)


def test_no_strand_is_an_error_that_says_what_to_do(
    unswept: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = Measured(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    monkeypatch.setattr("reconstruction.stages.line_strands", lambda *_, **__: ([], nothing))
    with pytest.raises(CaptureError, match="the method 'hull'"):
        reconstruct(unswept, Model(tmp_path), method="photometric")
    assert not (tmp_path / "strands.npz").exists()


def test_light_groups_are_neighbours() -> None:
    lights = [Light(f"l{i}", p, np.ones(3)) for i, p in enumerate(dome_positions(120, 1.0))]
    group = light_groups(lights, 12)
    assert sorted(set(group)) == list(range(12))
    positions = np.stack([light.position for light in lights])
    for k in range(12):
        apart = positions[group == k] @ positions[group == k].T
        assert np.degrees(np.arccos(apart.clip(-1, 1).min())) < 75
    assert len(set(light_groups(lights[:5], 12))) == 5


def test_thinning_keeps_the_mean_of_a_cell() -> None:
    points = np.array([[1e-4, 0, 0], [3e-4, 0, 0], [5e-3, 0, 0]])
    np.testing.assert_allclose(thinned(points, 1e-3), [[2e-4, 0, 0], [5e-3, 0, 0]])


def test_no_strand_is_longer_than_the_hair(model: tuple[Path, Report]) -> None:
    """Gaps are filled both ways, and what is found there is led to the scalp as well."""
    lengths = read_strands(model[0] / "strands.npz").lengths()
    assert lengths.max() < 0.12 + 1e-4
    assert lengths.max() > 0.114  # a ball of 10 cm has meridians of 31 cm


def test_observed_strands_are_not_covered_by_roots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A column of hair on the scalp's top: seen strands fill it, and no root has one."""
    grid = VoxelGrid(np.array([-4e-3, -4e-3, HEAD]), 4e-3, np.ones((3, 3, 10), bool))
    upright = np.tile([0, 0, 1.0], (90, 1))
    field, _ = solve_field(grid, grid.centers(), upright)
    observed = [p.astype(np.float32) for p in grid.centers().reshape(9, 10, 3)]
    monkeypatch.setattr("reconstruction.growing.grow_from_roots", lambda *_, **__: [])
    stages = GrowingStages(Model(tmp_path), QUICK, silent, Report())
    stages.grown(field, find_scalp(ball(HEAD)), list(observed))
    figures = stages.report["strands"].figures
    assert figures["covered"] == 1
    assert figures["covered_by_roots"] == 0


def test_hair_far_from_the_scalp_is_kept_without_roots(tmp_path: Path) -> None:
    """A tail 15 cm behind the head: its strands stay where they were measured, upper end first."""
    grid = VoxelGrid(np.array([-4e-3, 0.25, -0.1]), 4e-3, np.ones((3, 3, 10), bool))
    field, _ = solve_field(grid, grid.centers(), np.tile([0, 0, 1.0], (90, 1)))
    observed = [p.astype(np.float32) for p in grid.centers().reshape(9, 10, 3)]
    stages = GrowingStages(Model(tmp_path).create(), QUICK, silent, Report())
    scalp = find_scalp(ball(HEAD))
    grown = stages.grown(field, scalp, list(observed))
    assert not grown.rooted
    assert grown.strands.lengths().sum() >= 9 * 36e-3 * (1 - 1e-5)
    assert "no strand is rooted" in stages.report["strands"].warnings[0]
    measured = Measured(grid.centers(), np.tile([0, 0, 1.0], (90, 1)), np.ones(90))
    stages.rooted(grown.strands, measured, None, None)
    written = read_strands(tmp_path / "strands.npz")
    assert (written.roots[:, 2] > written.points[written.offsets[1:] - 1, 2]).all()
    assert written.points[:, 1].min() > 0.24
    assert stages.report["roots"].left_out


@pytest.mark.parametrize("given", [None, 1e-4])
def test_written_strands_are_thinner_where_they_are_dense_unless_a_radius_is_given(
    tmp_path: Path, given: float | None
) -> None:
    """Strands 3 mm apart, and as many 10 cm away that are 1 mm apart."""
    i, j = np.divmod(np.arange(400), 20)
    grid = np.stack([i, j, 0 * i], axis=1)
    roots = np.concatenate([3e-3 * grid, 1e-3 * grid + [0.16, 0, 0]])
    rise = np.arange(0, 0.06, 2e-3)[:, None] * (0, 0, 1)
    strands = Strands.from_list([root + rise for root in roots])
    measured = Measured(roots, np.tile([0, 0, 1.0], (800, 1)), np.ones(800))
    options = replace(QUICK, radius=given)
    GrowingStages(Model(tmp_path).create(), options, silent, Report()).rooted(
        strands, measured, None, None
    )
    radius = np.asarray(read_strands(tmp_path / "strands.npz").radius)
    if given is not None:
        assert radius.shape == ()
        assert radius == pytest.approx(given)
    else:
        sparse, dense = radius.reshape(2, -1)
        assert np.median(dense) < 0.5 * np.median(sparse)


def test_line_stereo_is_left_out_where_directions_are_certain(
    unswept: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("reconstruction.stages.line_strands", None)
    monkeypatch.setattr("reconstruction.pipeline.FINE_PIXEL", 1.0)
    report = reconstruct(unswept, Model(tmp_path), method="hull", options=COARSE)
    assert report["orientation"].figures["deviation_deg"] < 10
    assert not any("uncertain" in text for text in report["orientation"].warnings)
    assert "certain" in report["line stereo"].left_out[0].why


@pytest.mark.slow
def test_confidence_is_that_of_the_segments_not_what_they_count_in_the_field(
    unswept: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fibres along the equator that line stereo saw, where texture says that hair runs down."""
    around = np.linspace(0, 2 * np.pi, 400)
    line = 0.101 * np.stack([np.cos(around), np.sin(around), 0 * around], axis=1)
    along = np.stack([-np.sin(around), np.cos(around), 0 * around], axis=1)
    ones = np.ones(len(line), np.int64)
    segments = Segments(line, along, np.full(len(line), 0.2), 0 * ones, 3 * ones)
    monkeypatch.setattr("reconstruction.stages.line_strands", lambda *_, **__: ([line], segments))
    monkeypatch.setattr("reconstruction.pipeline.FINE_PIXEL", 1.0)
    for module in ("pipeline", "tangents.estimate"):  # texture is certain here
        monkeypatch.setattr(f"reconstruction.{module}.MOST_DEVIATION", -1.0)
    options = replace(COARSE, max_length=0.7)
    report = reconstruct(unswept, Model(tmp_path), method="hull", options=options)
    assert any("uncertain by" in text for text in report["orientation"].warnings)
    strands = read_strands(tmp_path / "strands.npz")
    on = (np.abs(strands.points[:, 2]) < 1e-5) & (np.abs(strands.tangents()[:, 2]) < 1e-3)
    assert on.sum() > 100
    assert strands.confidence is not None
    assert np.median(strands.confidence[on]) == pytest.approx(0.2, abs=0.03)
