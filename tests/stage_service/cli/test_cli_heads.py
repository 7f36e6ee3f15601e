"""`hairstage head`: heads from digitised points and from meshes of any unit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from reconstruction import Mesh, Stage, read_obj, write_obj
from reconstruction.geometry.closest_point import ClosestPoint
from reconstruction.geometry.mesh_queries import surface_samples
from reconstruction.head.capture_head import HeadPoints, fit_capture_head
from reconstruction.head.fit import HeadHints
from reconstruction.head.generic import generic_head
from stage_service.cli import main


def test_a_head_is_fitted_to_points_of_its_scalp(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    head = generic_head()
    assert head.scalp is not None
    points, _, face = surface_samples(head, 8e-3)
    np.savetxt(tmp_path / "scalp.csv", 1.05 * points[head.scalp[face]], delimiter=",")
    words = ["head", "fit", tmp_path / "scalp.csv", "--turn-deg", 0, "--out", tmp_path / "h.obj"]
    assert main([*map(str, words), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["rms_mm"] < 0.5
    assert data["used_share"] > 0.95
    assert data["fit"]["scale"] == pytest.approx(1.05, abs=0.01)
    laid = read_obj(tmp_path / "h.obj")
    assert laid.scalp is not None
    off = ClosestPoint(laid, 8e-3)(1.05 * head.vertices[np.unique(head.faces[head.scalp])])[2]
    assert np.median(off) < 5e-4


@pytest.mark.slow
def test_a_mesh_in_inches_with_y_up_becomes_a_template(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    head = generic_head()
    upright = Mesh(head.vertices, head.faces).transformed([[1, 0, 0], [0, 0, 1], [0, -1, 0]], 0)
    write_obj(tmp_path / "own.obj", Mesh(39.37 * upright.vertices, upright.faces))
    words = ["head", "mark", tmp_path / "own.obj", "--up", "y", "--out", tmp_path / "t.obj"]
    assert main([*map(str, words), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["unit_m"] == pytest.approx(0.0254, rel=0.01)
    assert head.scalp is not None
    assert data["scalp_cm2"] == pytest.approx(1e4 * head.face_areas()[head.scalp].sum(), rel=0.1)
    marked = read_obj(tmp_path / "t.obj")
    assert np.abs(np.sort(marked.vertices[:, 2]) - np.sort(head.vertices[:, 2])).max() < 3e-3


def egg() -> Mesh:
    """As long as a head from chin to crown, and alike from all sides: it faces nowhere."""
    around, down = np.meshgrid(np.arange(60) * np.pi / 30, np.linspace(0.02, np.pi - 0.02, 40))
    level = np.stack([np.sin(down) * np.cos(around), np.sin(down) * np.sin(around)], axis=-1)
    points = np.concatenate([0.09 * level, 0.12 * np.cos(down)[..., None]], axis=-1)
    at = np.arange(40 * 60).reshape(40, 60)
    a, b = at[:-1], at[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    return Mesh(points.reshape(-1, 3), faces)


@pytest.mark.slow
def test_a_mesh_without_a_recognised_face_gives_a_warning(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    own, head = tmp_path / "egg.obj", generic_head()
    write_obj(own, egg())
    assert main(["head", "mark", str(own), "--out", str(tmp_path / "t.obj")]) == 0
    assert "warning: another pose fits nearly as well" in capsys.readouterr().out
    points, _, face = surface_samples(head, 8e-3)
    np.save(tmp_path / "scalp.npy", points[head.scalp[face]])
    words = ["head", "fit", tmp_path / "scalp.npy", "--mesh", own, "--out", tmp_path / "h.obj"]
    assert main([*map(str, words)]) == 0
    assert f"warning: {own}: its scalp: another pose fits nearly as" in capsys.readouterr().out
    stage = Stage("head")
    known = HeadPoints(points[head.scalp[face]], None, HeadHints(part="scalp"), "scalp.npy")
    fit_capture_head(known, own, stage)
    assert any("egg.obj: its scalp: another pose" in w for w in stage.warnings)


def test_errors_are_reported_with_exit_code_3(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    np.save(tmp_path / "few.npy", np.eye(3))
    assert main(["head", "fit", str(tmp_path / "few.npy"), "--out", str(tmp_path / "h.obj")]) == 3
    assert "3 points, at least 10" in capsys.readouterr().err
    assert main(["head", "mark", "x.obj", "--out", str(tmp_path / "h.stl")]) == 3
    assert "must end in .obj" in capsys.readouterr().err
