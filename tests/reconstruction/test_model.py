"""A model folder: which head counts, what a crash leaves, what a missing file's error says."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from reconstruction import (
    Capture,
    CaptureError,
    Mesh,
    Model,
    ModelError,
    Report,
    Strands,
    write_obj,
)
from reconstruction.light_planes import PointCloud

TRIANGLE = Mesh(np.eye(3), np.array([[0, 1, 2]]))
LARGER = Mesh(2 * np.eye(3), np.array([[0, 1, 2]]))
HAIR = Strands.from_list([np.eye(3), np.eye(3)[:2]])


@pytest.fixture
def model(tmp_path: Path) -> Model:
    return Model(tmp_path / "model").create()


def test_the_fitted_head_comes_before_the_captures(
    model: Model, shoot: Callable[..., Capture]
) -> None:
    capture = shoot(projectors=[], samples=1)
    assert model.head(capture) is None
    write_obj(capture.path / "head.obj", TRIANGLE)
    capture = Capture(capture.path)
    used = model.head(capture)
    assert used is not None
    np.testing.assert_array_equal(used.vertices, TRIANGLE.vertices)
    model.write_head(LARGER)
    for used in (model.head(capture), model.head(None)):
        assert used is not None
        np.testing.assert_array_equal(used.vertices, LARGER.vertices)


def test_a_crash_in_the_middle_leaves_the_old_file(
    model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    model.write_head(TRIANGLE)
    before = (model.path / "head.obj").read_bytes()

    def killed(path: Path, _mesh: Mesh) -> None:
        path.write_text("v 0 0")
        raise KeyboardInterrupt

    monkeypatch.setattr("reconstruction.model.write_obj", killed)
    with pytest.raises(KeyboardInterrupt):
        model.write_head(LARGER)
    assert (model.path / "head.obj").read_bytes() == before
    model.write_json("results.json", {"f": 1.0})
    with pytest.raises(ValueError, match="not JSON compliant"):
        model.write_json("results.json", {"f": float("nan")})
    assert model.json("results.json") == {"f": 1.0}
    assert list(model.artifacts()) == ["head.obj", "results.json"]


def test_a_missing_file_is_named_with_the_command_that_makes_it(
    model: Model, shoot: Callable[..., Capture]
) -> None:
    with pytest.raises(ModelError, match=r"strands\.npz is missing: run 'hairstage reconstruct"):
        model.strands()
    with pytest.raises(ModelError, match=r"points\.npz is missing: run 'hairstage reconstruct"):
        model.points()
    with pytest.raises(ModelError, match=r"hair_maps\.npz is missing: run 'hairstage fit"):
        model.arrays("hair_maps.npz")
    with pytest.raises(ModelError, match=r"masks/left_hair\.png is missing: run"):
        model.mask("left", "hair", shoot(projectors=[], samples=1))
    with pytest.raises(KeyError, match=r"no file 'strand\.npz'; there are .*strands\.npz"):
        model.file("strand.npz")
    assert model.report() == Report()
    (model.path / "rig.json").write_text("{}")
    with pytest.raises(ModelError, match=r"is a capture, not a model: run 'hairstage reconstruct "):
        model.strands()


def test_masks_fall_back_to_the_users(model: Model, shoot: Callable[..., Capture]) -> None:
    capture = shoot(projectors=[], samples=1)
    camera = capture.rig.camera("left")
    shape = (camera.height, camera.width)
    assert not model.mask("left", "skin", capture).any()
    user = np.zeros(shape, bool)
    user[3, 4] = True
    other = Model(capture.path)  # its masks/ is where a user's lie
    other.create().write_mask("left", "hair", user)
    (capture.path / "masks" / "left_hair.png").rename(capture.path / "masks" / "left.png")
    np.testing.assert_array_equal(model.mask("left", "hair", capture), user)
    model.write_mask("left", "hair", ~user)
    np.testing.assert_array_equal(model.mask("left", "hair", capture), ~user)
    model.write_mask("left", "hair", user[1:])
    with pytest.raises(CaptureError, match=r"left_hair\.png"):
        model.mask("left", "hair", capture)


def test_roots_on_the_map_are_those_of_these_strands(model: Model) -> None:
    assert model.root_uv(HAIR) is None
    roots = np.array([[0.25, 0.5], [0.75, 1.1]])
    model.write_arrays("scalp_map.npz", {"roots": roots})
    np.testing.assert_array_equal(model.root_uv(HAIR), [[0.25, 0.5], [0.75, 1.0]])
    assert model.root_uv(Strands.from_list([np.eye(3)])) is None  # a map of other strands


def test_new_strands_leave_nothing_that_was_made_of_others(model: Model) -> None:
    kept = ["masks/left_hair.png", "progress.json", "strands.hair", "strands.npz", "strands.usdc"]
    model.write_mask("left", "hair", np.ones((2, 2), bool))
    model.write_json("progress.json", {})
    for name in ("appearance.json", "lights.json", "results.json"):
        model.write_json(name, {})
    for name in ("hair_maps.npz", "scalp_map.npz"):
        model.write_arrays(name, {"roots": np.zeros((2, 2))})
    for name in ("comparison.png", "relit.png", "render.png", "plots/geometry.png"):
        model.write_png(name, np.zeros((2, 2), np.uint8))
    model.write_strands(HAIR)
    assert list(model.artifacts()) == kept


def test_artifacts_exclude_partial_files_and_outside_links(model: Model, tmp_path: Path) -> None:
    model.write_strands(HAIR)
    model.write_points(PointCloud.empty(("left",), ()))
    model.write_mask("left", "hair", np.ones((2, 2), bool))
    model.write_report(Report())
    (model.path / ".part-relit.png").write_bytes(b"half")
    (tmp_path / "secret").write_text("of somebody else")
    (model.path / "relit.png").symlink_to(tmp_path / "secret")
    listed = "masks/left_hair.png points.npz report.json strands.hair strands.npz strands.usdc"
    assert list(model.artifacts()) == listed.split()
    np.testing.assert_array_equal(model.strands().points, HAIR.points)
    assert len(model.points()) == 0
