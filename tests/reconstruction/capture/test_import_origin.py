"""A world whose subject is elsewhere than about its origin is moved there as it is imported."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reconstruction import Camera, Capture, Light, import_folder, write_exr
from reconstruction.capture.import_folder import Import
from reconstruction.capture.import_geometry import Geometry
from reconstruction.capture.import_origin import Origin
from reconstruction.files.points import read_points
from reconstruction.geometry.lens_models import LensModel, LensModelCamera
from reconstruction.geometry.mesh import Mesh, write_obj
from reconstruction.geometry.projectors import Projector
from stage_service.cli import main

AWAY = np.array([0.3, -0.2, 1.6])
EYES = ([0.9, 0.1, 0.2], [-0.2, 0.9, 0.1], [-0.6, -0.7, 0.3])
LIGHTS = ([1.4, 0.0, 0.5], [0.1, -1.5, 0.3])
HEAD = Mesh(np.array([[0, 0, 0.1], [0.1, 0, 0], [0, 0.1, 0]]), np.array([[0, 1, 2]]))
NORMALS = "vn 0 0 1\nvn 1 0 0\nvn 0 1 0\n"


def cameras(at: Sequence[float]) -> list[Camera]:
    """Cameras that look at `at`, one of them through a lens."""
    lens = [-0.1, 0.02, 0, 0, 0]
    out = [Camera.look_at(f"cam_{i}", 8, 6, np.add(at, eye), at, 30) for i, eye in enumerate(EYES)]
    return [replace(out[0], distortion=lens), *out[1:]]


def folder(root: Path, at: Sequence[float]) -> Path:
    """A stage about `at`."""
    stage = cameras(at)
    table = [{**c.to_dict(), "id": c.name} for c in stage]
    lights = [
        {"id": f"light_{i}", "position": np.add(at, p).tolist(), "intensity": [1, 2, 3]}
        for i, p in enumerate(LIGHTS)
    ]
    beam = Projector.look_at("proj_0", 8, 4, np.add(at, [0, -1, 0.2]), at, 20)
    for camera in stage:
        (root / "images" / camera.name).mkdir(parents=True)
        for light in lights:
            picture = root / "images" / camera.name / f"{light['id']}.exr"
            write_exr(picture, np.full((6, 8, 3), 0.5, np.float32))
    (root / "cameras.json").write_text(json.dumps({"cameras": table}))
    (root / "lights.json").write_text(json.dumps({"lights": lights}))
    (root / "projectors.json").write_text(json.dumps({"projectors": [beam.to_dict()]}))
    moved = HEAD.transformed(np.eye(3), at)
    write_obj(root / "head.obj", moved)
    points = "".join(f"v {x} {y} {z}\n" for x, y, z in moved.vertices)
    (root / "scalp.obj").write_text(points + NORMALS)
    return root


def assert_same(a: Capture, b: Capture) -> None:
    for devices in ("cameras", "projectors"):
        for x, y in zip(getattr(a.rig, devices), getattr(b.rig, devices), strict=True):
            np.testing.assert_allclose(y.R, x.R, atol=1e-12)
            np.testing.assert_allclose(y.t, x.t, atol=1e-9)
    for x, y in zip(a.rig.lights, b.rig.lights, strict=True):
        np.testing.assert_allclose(y.position, x.position, atol=1e-9)
        assert y.name == x.name
    assert a.head is not None
    assert b.head is not None
    np.testing.assert_allclose(b.head.vertices, a.head.vertices, atol=1e-8)
    for x, y in zip(*(read_points(c.path / "scalp.obj") for c in (a, b)), strict=True):
        np.testing.assert_allclose(y, x, atol=1e-8)


def test_a_subject_that_is_elsewhere_is_moved_to_the_origin(tmp_path: Path) -> None:
    still = import_folder(folder(tmp_path / "still", [0, 0, 0]), tmp_path / "a")
    away = import_folder(folder(tmp_path / "away", AWAY.tolist()), tmp_path / "b")
    assert_same(still, away)
    frame = {"unit": 1.0, "up": "z", "origin": [0.0, 0.0, 0.0]}
    (curve,) = still.plan["import"]["notes"]
    assert "no fully lit frame" in curve
    assert still.plan["import"] == {"notes": [curve], "relative": False, "frame": frame}
    assert away.plan["import"]["frame"] == {**frame, "origin": AWAY.tolist()}
    note, _ = away.plan["import"]["notes"]
    assert "the cameras look at (0.300, -0.200, 1.600) m" in note
    assert "were moved by (-0.300, 0.200, -1.600) m" in note


def test_a_subject_near_the_origin_stays_where_it_is(tmp_path: Path) -> None:
    at = [0.05, -0.04, 0.06]
    capture = import_folder(folder(tmp_path / "near", at), tmp_path / "out")
    assert capture.world is not None
    assert capture.world.same
    for camera, given in zip(capture.rig.cameras, cameras(at), strict=True):
        assert camera.t.tolist() == given.t.tolist()
    text = (tmp_path / "out" / "scalp.obj").read_bytes()
    assert text == (tmp_path / "near" / "scalp.obj").read_bytes()


def test_lights_that_aim_and_other_lenses_are_moved_alike(tmp_path: Path) -> None:
    turn = np.array([[0, 1, 0], [0, 0, -1], [-1, 0, 0.0]])
    observed = []
    for name, at in (("still", np.zeros(3)), ("away", AWAY)):
        stage = [
            LensModelCamera(c.name, 8, 6, c.K, c.R, c.t, lens=LensModel("fisheye", [0.01, 0, 0, 0]))
            for c in cameras(at)
        ]
        lights = [
            Light(f"light_{i}", at + p, np.ones(3), orientation=turn, size=(0.1, 0.2))
            for i, p in enumerate(LIGHTS)
        ]
        geometry = Geometry({c.name: c for c in stage}, lights)
        observed.append(Import.of(folder(tmp_path / name, at.tolist()), geometry))
    still, away = observed
    for a, b in zip(still.rig.lights, away.rig.lights, strict=True):
        point = [0.02, 0.01, -0.03]
        np.testing.assert_allclose(b.intensity_towards(point), a.intensity_towards(point))
        assert a.intensity_towards(point).any()
    for name, camera in still.shot.items():
        np.testing.assert_allclose(away.shot[name].t, camera.t, atol=1e-9)
        np.testing.assert_allclose(away.rig.camera(name).t, camera.t, atol=1e-9)


def test_a_dry_run_names_the_shift(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    away = folder(tmp_path / "away", AWAY.tolist())
    assert main(["import", str(away), "--out", str(tmp_path / "out"), "--dry-run"]) == 0
    said = capsys.readouterr()
    assert "moved by (-0.300, 0.200, -1.600) m" in said.out + said.err
    assert not (tmp_path / "out").exists()


def test_cameras_that_do_not_say_where_the_subject_is() -> None:
    """All look ahead, or nearly so, as a pair of a few degrees does."""
    parallel = [Camera.look_at(str(x), 8, 6, [x, -1, 2], [x, 0, 2], 30) for x in (0.0, 0.2)]
    pair = [Camera.look_at(str(x), 8, 6, [x, -1, 2], [0, 0, 2], 30) for x in (-0.1, 0.1)]
    apart = [
        Camera.look_at(str(e), 8, 6, np.add([0, 0, 2], e), np.add([0, 0, 2], 2 * np.array(e)), 30)
        for e in EYES
    ]
    assert "there is only one" in Origin.of(pair[:1]).notes[0]
    for stage, why in ((parallel, "are parallel"), (pair, "nearly parallel"), (apart, "one point")):
        origin = Origin.of(stage)
        assert not origin.moved
        (note,) = origin.notes
        assert why in note
        assert "assumed at the origin" in note
