"""The loop: strands exported lie on the user's own pictures, by the user's own file of cameras.

Nothing of ours reads the files back: USD by its own library, Alembic by alembic3d, `.hair` by its
header, and the cameras' numbers are taken out of the text that the user gave.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import camera_writers as writers
import cv2
import numpy as np
import pytest
import users_cameras as readers
from pxr import Usd, UsdGeom
from users_cameras import Pixels

from reconstruction import Camera, Capture, Model, Strands
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.placement import METRES, to_z_up
from stage_service.cli import main

SIZE = 64
AT = np.array([0.31, -0.22, 1.58])
"""Where the subject is in the user's world, metres with z up."""
HEAD = Mesh(0.1 * np.eye(3), [[0, 1, 2]])


def hair() -> Strands:
    """Strands of the stage, 12 cm from its origin at most."""
    rng = np.random.default_rng(5)
    turns = np.linspace(0, 1, 20)[:, None] * rng.normal(0, 0.03, (40, 1, 3))
    return Strands.from_list(list(rng.uniform(-0.05, 0.05, (40, 1, 3)) + turns), 5e-5)


def stage(up: str, unit: float) -> list[Camera]:
    """Cameras around `AT` in the user's axes and unit."""
    turn, out = to_z_up(up), []
    for k in range(5):
        a = 0.9 * k
        eye = AT + 0.9 * np.array([np.cos(a), np.sin(a), 0.3 * np.sin(2 * a)])
        c = Camera.look_at(f"{k + 1:02d}", SIZE, SIZE, eye, AT, 20)
        R = c.R @ turn
        t = -R @ (turn.T @ eye) / unit
        out.append(Camera(c.name, SIZE, SIZE, c.K, R, t, distortion=writers.LENS))
    return out


def write_json(path: Path, cameras: list[Camera]) -> None:
    entries = [
        {"id": c.name, "width": SIZE, "height": SIZE}
        | {k: np.asarray(getattr(c, k)).tolist() for k in ("K", "R", "t", "distortion")}
        for c in cameras
    ]
    path.write_text(json.dumps({"cameras": entries}))


World = tuple[Callable[[Path, list[Camera]], None], Callable[[Path], Pixels], str, str | float, str]
WORLDS: dict[str, World] = {
    "colmap": (writers.write_colmap_text, readers.of_colmap, "sparse", "mm", "-y"),
    "colmap, metres": (writers.write_colmap_text, readers.of_colmap, "sparse", "m", "z"),
    "metashape": (writers.write_metashape, readers.of_metashape, "cameras.xml", "m", "y"),
    "easymocap": (writers.write_easymocap, readers.of_easymocap, "calib", "m", "-y"),
    "nerfstudio": (writers.write_transforms, readers.of_nerfstudio, "transforms.json", 0.37, "z"),
    "json": (write_json, readers.of_json, "cameras.json", "mm", "y"),
}
"""Writer, reader that shares nothing with us, file, unit and up axis."""


def of_usd(path: Path) -> tuple[np.ndarray, float, str]:
    """Points as they are stored, metres per unit, up axis."""
    opened = Usd.Stage.Open(str(path))
    curves = next(UsdGeom.BasisCurves(p) for p in opened.Traverse() if UsdGeom.BasisCurves(p))
    unit, up = UsdGeom.GetStageMetersPerUnit(opened), UsdGeom.GetStageUpAxis(opened)
    return np.array(curves.GetPointsAttr().Get(), float), unit, up


def of_hair(path: Path) -> np.ndarray:
    data = path.read_bytes()
    _, strands, points = struct.unpack("<4sII", data[:12])
    start = 128 + 2 * strands
    return np.frombuffer(data[start : start + 12 * points], "<f4").reshape(-1, 3).astype(float)


def of_abc(path: Path) -> np.ndarray:
    abc = pytest.importorskip("alembic3d")
    curves = abc.AbcGeom.ICurves(abc.Abc.IArchive(str(path)).getTop(), "hair")
    values = curves.getSchema().getValue().getPositions()
    return np.array([[p.x, p.y, p.z] for p in values], float)


FAST = ("colmap", "metashape", "json")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * (n not in FAST)) for n in WORLDS]
)
def test_exported_strands_lie_on_the_users_pictures(name: str, tmp_path: Path) -> None:
    write, read, file, unit, up = WORLDS[name]
    metres = METRES.get(str(unit), unit)
    folder = tmp_path / "folder"
    folder.mkdir()
    cameras = stage(up, metres)
    write(folder / file, cameras)
    pixels = read(folder / file)
    turn = to_z_up(up)
    lights = [[float(x) for x in turn.T @ (AT + p) / metres] for p in (-np.eye(3), np.eye(3))[0]]
    rows = "".join(f"led_{k},{x},{y},{z}\n" for k, (x, y, z) in enumerate(lights))
    if name == "json":
        entries = [
            {"id": f"led_{k}", "position": x, "intensity": [1, 1, 1]} for k, x in enumerate(lights)
        ]
        (folder / "lights.json").write_text(json.dumps({"lights": entries}))
    else:
        (folder / "lights.csv").write_text("name,x,y,z\n" + rows)
    for camera in cameras:
        (folder / "images" / camera.name).mkdir(parents=True)
        for k in range(len(lights)):
            picture = np.full((SIZE, SIZE, 3), 9000, np.uint16)
            cv2.imwrite(str(folder / "images" / camera.name / f"led_{k}.png"), picture)
    words = ["import", str(folder), "--out", str(tmp_path / "capture")]
    assert main([*words, "--unit", str(unit), "--up", up]) == 0

    capture, model = Capture(tmp_path / "capture"), Model(tmp_path / "model")
    model.create().start(capture.world)
    model.write_strands(hair())
    model.write_head(HEAD)
    np.testing.assert_allclose(model.strands().points, hair().points, atol=1e-6)
    np.testing.assert_allclose(model.head(None).vertices, HEAD.vertices, atol=1e-7)

    # the user's pictures, as the rig took them: strands of the stage in the capture's own cameras
    pictures = {c.name: c.project(hair().points)[0] for c in capture.rig.cameras}

    def residual(points: np.ndarray) -> float:
        found = pixels(points)
        assert sorted(found) == sorted(pictures)
        return max(float(np.abs(found[c] - pictures[c]).max()) for c in found)

    def exported(to: str, file: str, *more: str) -> Path:
        out = tmp_path / file
        assert main(["export", str(model.path), "--to", to, "--out", str(out), *more]) == 0
        return out

    stored, per_unit, axis = of_usd(exported("usd", "groom.usdc"))
    off = {"usd": residual(stored), "hair": residual(of_hair(exported("hair", "h.hair")))}
    off |= {"usdc": residual(of_usd(model.file("strands.usdc"))[0])}
    off |= {"model hair": residual(of_hair(model.file("strands.hair")))}
    off |= {"npz": residual(np.load(model.file("strands.npz"))["points"].astype(float))}
    if pytest.importorskip("alembic3d"):
        off |= {"abc": residual(of_abc(exported("abc", "h.abc")))}
    print(name, {k: f"{v:.4f}" for k, v in off.items()})
    assert max(off.values()) < 0.1, off
    assert per_unit == pytest.approx(metres)
    assert axis == ("Y" if up == "y" else "Z")

    # a format that fixes its axes has the same place in them: metres, y up
    stored, per_unit, axis = of_usd(exported("houdini", "houdini.usdc"))
    assert (per_unit, axis) == (1.0, "Y")
    back = stored[:, [0, 2, 1]] * [1, -1, 1]
    assert residual(back @ turn / metres) < 0.1
    # ours, if wanted
    stored, per_unit, _ = of_usd(exported("usd", "stage.usdc", "--frame", "stage"))
    np.testing.assert_allclose(stored, hair().points, atol=1e-6)
    # what comes back from the user's program is where it was
    words = ["evaluate", "geometry", str(tmp_path / "h.hair"), str(tmp_path / "groom.usdc")]
    if axis == "Y":
        out = tmp_path / "scores"
        assert main([*words, "--capture", str(capture.path), "--out", str(out)]) == 0
        scores = json.loads((out / "report.json").read_text())
        assert scores["all"]["1mm_10deg"]["f"] > 0.99
