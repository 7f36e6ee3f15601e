"""A small file of every format that is read, and its reader."""

from __future__ import annotations

import json
import shutil
import struct
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import camera_writers as writers
import cv2
import numpy as np
from dng_writer import write_dng

from appearance import Exposure, FittedModel, HairAppearance, HeldOut
from appearance.bsdf.maps import HairMaps
from appearance.fields.anchors import Grid, Places
from appearance.fields.field import Field
from appearance.inverse_rendering.fitted_lights import save_lights
from appearance.render.environment_maps import load_environment
from appearance.render.harmonics import count_of
from appearance.sun_fit.fitted_appearance import FittedAppearance
from reconstruction import (
    Camera,
    Capture,
    CaptureWriter,
    Light,
    Model,
    Rig,
    Step,
    Strands,
    read_obj,
    read_strands,
    verify,
    write_strands,
)
from reconstruction.capture.import_settings import read_settings
from reconstruction.capture.import_tables import cameras_of, lights_of
from reconstruction.files.cameras import read_cameras
from reconstruction.files.exr import read_exr, write_exr
from reconstruction.files.lights import read_lights
from reconstruction.files.pictures import Sensor, read_picture
from reconstruction.files.points import read_points
from reconstruction.files.strands import read_poses
from reconstruction.geometry.ies import read_ies
from reconstruction.light_planes.point_cloud import PointCloud
from reconstruction.reading import parse_json
from reconstruction.report.report import Report
from simulators.peers.faults import Faults
from stage_service.acquisition.states import read_status
from stage_service.captures.capture_queue import CaptureQueue
from stage_service.captures.hold import Hold
from stage_service.captures.latch import Latch
from stage_service.captures.status_index import StatusIndex
from stage_service.config import load_rig_file
from stage_service.jobs.records import PipelineRequest
from stage_service.plan.capture_plan import CapturePlan
from stage_service.records.audit import AuditLog
from stage_service.records.events import EventLog
from stage_service.records.tokens import Tokens


def _rig() -> Rig:
    cameras = tuple(Camera.look_at(f"cam_{i}", 8, 6, [i, -1, 0], [0, 0, 0], 20) for i in (0, 1))
    return Rig("two", cameras, (Light("light_0", np.array([0.0, 1, 1]), np.ones(3)),))


def _capture(folder: Path) -> Path:
    steps = (Step(0, "dark", 0.01, 0.0), Step(1, "olat", 0.01, 0.5, light="light_0"))
    writer = CaptureWriter.create(folder / "capture", _rig(), {"steps": steps})
    for step in steps:
        for i in (0, 1):
            writer.write_frame(step, f"cam_{i}", np.full((6, 8, 3), 0.5, np.float32))
    writer.finish("completed")
    return folder / "capture"


def _of_capture(name: str) -> Callable[[Path], tuple[Path, Callable[[Path], Any]]]:
    def make(folder: Path) -> tuple[Path, Callable[[Path], Any]]:
        path = _capture(folder)

        def read(_file: Path) -> None:
            assert read_status(path).state == "done"  # whatever it is, it is listed
            capture = Capture(path)
            for step in capture.steps:
                for camera in capture.rig.cameras:
                    if capture.has(step, camera.name):
                        capture.frame(step, camera.name)
            verify(path)

        return path / name, read

    return make


def _strands(suffix: str) -> Callable[[Path], tuple[Path, Callable[[Path], Any]]]:
    def make(folder: Path) -> tuple[Path, Callable[[Path], Any]]:
        rng = np.random.default_rng(0)
        points = rng.normal(size=(12, 3)).astype(np.float32)
        file = folder / f"strands.{suffix}"
        write_strands(file, Strands(points, np.array([0, 5, 12])))
        return file, read_strands

    return make


def _exr(folder: Path) -> tuple[Path, Callable[[Path], Any]]:
    file = folder / "frame.exr"
    write_exr(file, np.random.default_rng(0).random((6, 8, 3), np.float32))
    return file, read_exr


def _picture(name: str, kind: type[np.integer[Any]]) -> Callable[..., Any]:
    def make(folder: Path) -> tuple[Path, Callable[[Path], Any]]:
        file = folder / name
        values = np.random.default_rng(0).integers(np.iinfo(kind).max, size=(6, 8, 3), dtype=kind)
        assert cv2.imwrite(str(file), values)
        return file, lambda path: read_picture(path, Sensor(), (8, 6))

    return make


def _raw(folder: Path) -> tuple[Path, Callable[[Path], Any]]:
    file = folder / "frame.dng"
    values = np.random.default_rng(0).integers(1 << 16, size=(24, 32), dtype=np.uint16)
    write_dng(file, values)
    return file, lambda path: read_picture(path, Sensor(), (32, 24))


def _cameras(write: Callable[..., None], name: str, part: str = "") -> Callable[..., Any]:
    def make(folder: Path) -> tuple[Path, Callable[[Path], Any]]:
        write(folder / name, _rig().cameras)
        return folder / name / part, lambda _: read_cameras(folder / name)

    return make


def _file(name: str, data: bytes, read: Callable[[Path], Any]) -> Callable[..., Any]:
    def make(folder: Path) -> tuple[Path, Callable[[Path], Any]]:
        (folder / name).write_bytes(data)
        return folder / name, read

    return make


def _hdr(folder: Path) -> tuple[Path, Callable[[Path], Any]]:
    file = folder / "room.hdr"
    assert cv2.imwrite(str(file), np.random.default_rng(0).random((6, 12, 3), np.float32))
    return file, load_environment


def _floats(count: int) -> bytes:
    return np.linspace(-1, 1, count, dtype="<f4").tobytes()


STRANDS_PLY = b"ply\nformat ascii 1.0\nelement vertex 12\n"
STRANDS_PLY += b"".join(b"property float %c\n" % c for c in b"xyz")
STRANDS_PLY += b"property uchar red\nend_header\n"
STRANDS_PLY += b"".join(b"%d 0 %d %d\n" % (k // 4, k % 4, k // 4) for k in range(12))
CUBIC = b"""#usda 1.0
def BasisCurves "hair" {
    uniform token type = "cubic"
    uniform token basis = "catmullRom"
    uniform token wrap = "pinned"
    int[] curveVertexCounts = [3, 4]
    point3f[] points = [(0,0,0), (0,0,1), (0,1,1), (1,0,0), (1,0,1), (1,1,1), (1,2,1)]
    float[] widths = [0.1, 0.1, 0, 0.1, 0.1, 0.1, 0]
}
"""
PLY = b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n%send_header\n" % b"".join(
    b"property float %s\n" % n for n in (b"x", b"y", b"z", b"nx", b"ny", b"nz")
)
IES = b"""IESNA:LM-63-2002
[TEST] none
TILT=NONE
1 1000 1.5 5 1 1 2 0.1 0.1 0
1.0 1.0 20
0 22.5 45 67.5 90
0
100 90 70 40 0
"""


def _obj(folder: Path) -> tuple[Path, Callable[[Path], Any]]:
    file = folder / "head.obj"
    lines = [f"v {i} {i % 3} 0.5" for i in range(8)] + ["g scalp"]
    file.write_text("\n".join([*lines, "f 1 2 3", "f 3/1/2 4 5 6", "f -1 -2 -3"]) + "\n")
    return file, read_obj


def _toml(folder: Path) -> tuple[Path, Callable[[Path], Any]]:
    file = folder / "rig.toml"
    shutil.copy(Path(__file__).resolve().parents[1] / "stage_service/rigs/demo.toml", file)
    tomllib.loads(file.read_text())
    return file, load_rig_file


def _json(value: Any, check: Callable[[Any], Any]) -> Callable[..., Any]:
    def make(folder: Path) -> tuple[Path, Callable[[Path], Any]]:
        file = folder / "request.json"
        file.write_text(json.dumps(value))
        return file, lambda path: check(parse_json(path.read_bytes()))

    return make


def _numpy(name: str, read: Callable[[Path], Any], **arrays: Any) -> Callable[..., Any]:
    """A file of NumPy's: `.npy` of the one array, `.npz` of all."""

    def make(folder: Path) -> tuple[Path, Callable[[Path], Any]]:
        file = folder / name
        if file.suffix == ".npy":
            np.save(file, next(iter(arrays.values())))
        else:
            np.savez_compressed(file, allow_pickle=False, **arrays)
        return file, read

    return make


def _mask(folder: Path) -> tuple[Path, Callable[[Path], Any]]:
    mask = np.zeros((6, 8), np.uint8)
    mask[2:4] = 255
    assert cv2.imwrite(str(folder / "cam_0.png"), mask)
    capture = Capture(_capture(folder))

    def read(file: Path) -> None:
        capture.read_mask(file, "cam_0")

    return folder / "cam_0.png", read


def _of_model(name: str) -> Callable[[Path], tuple[Path, Callable[[Path], Any]]]:
    def make(folder: Path) -> tuple[Path, Callable[[Path], Any]]:
        model, capture = Model(folder / "model").create(), Capture(_capture(folder))
        points = np.random.default_rng(0).normal(size=(12, 3)).astype(np.float32)
        root_uv, hair = (
            np.array([[0.2, 0.3], [0.6, 0.9]]),
            HairAppearance((0.1, 0.2, 0.3), 0.3, 0.3),
        )
        skin, light = (0.3, 0.2, 0.1), capture.rig.lights[:1]
        model.write_strands(Strands(points, np.array([0, 5, 12])))
        model.write_arrays("scalp_map.npz", {"roots": root_uv})
        FittedAppearance(hair, skin, skin, Exposure(1.0), 0.1, 0.1, 0.1, HeldOut()).save(model)
        HairMaps.of(hair, (2, 2, 2)).save(model, root_uv)
        save_lights(model, np.ones(1), light)
        rows, values = np.array([0, 3]), np.ones((2, 3 * count_of(1) ** 2), np.float32)
        Field("modulation", 1, Grid(2, 2, 2, 0), Places.of(root_uv), rows, values).save(model)
        PointCloud.empty(("cam_0",), ("left",)).save(model.file("points.npz"))
        Report().save(model.file("report.json"))

        def read(_file: Path) -> None:
            FittedModel.load(model, capture)
            model.root_uv(model.strands())
            PointCloud.load(model.file("points.npz"))
            Report.load(model.file("report.json"))

        return model.file(name), read

    return make


TOKENS = [{"name": "ada", "scopes": ["read"], "sha256": "0" * 64, "made": "2026-01-01T00:00:00Z"}]
MODEL = ("appearance.json", "hair_maps.npz", "lights.json", "field.npz", "scalp_map.npz")
MODEL += ("points.npz", "report.json")
ENTRY = {"id": "q1", "by": "ada", "added": "2026-01-01T00:00:00Z", "request": {"plan": {}}}
QUEUE = {"held": [], "waiting": [ENTRY], "history": []}
INDEX = ["x", [[1, 2, 3], [4, 5, 6], None, None], {"id": "x", "state": "done", "frames": 3}]
SETTINGS = b"""exposure = 0.02
units = "radiance"
[pictures]
olat = "{camera}/{light}.png"
[sensor]
black = 64
"""
CAMERA = {"id": 0, "width": 8, "height": 6, "K": np.eye(3).tolist(), "R": np.eye(3).tolist()}
CAMERAS = {"cameras": [{**CAMERA, "t": [0.1, 0.2, 1.5]}]}
LIGHT = {"id": 3, "position": [0.5, 1, 2], "intensity": [8, 8, 8], "colocated_camera": 0}
LIGHTS = {"lights": [LIGHT]}
FAULTS = [{"device": "camera", "kind": "drop", "pulse": 3, "camera": "cam_0"}]
ACTION = {"time": "2026-01-01T00:00:00Z", "who": "ada", "action": "x", "subject": "y"}
LATCHED = {"since": "2026-01-01T00:00:00Z", "detail": "a lamp stays lit", "reads_back": True}


def _state(name: str, value: Any, read: Callable[[Path], Any]) -> Callable[..., Any]:
    return _file(name, json.dumps(value).encode(), read)


def _tokens(file: Path) -> None:
    tokens = Tokens(file)
    tokens.find("x")  # a file that cannot be read opens nothing
    tokens.entries()


def _queue(file: Path) -> None:
    CaptureQueue(file, EventLog(), lambda _: "", lambda: None, Hold(EventLog()))
    file.unlink(missing_ok=True)
    for aside in file.parent.glob("*.broken-*"):
        aside.unlink()


FORMATS = {
    "exr": _exr,
    "frame": _of_capture("frames/00001/cam_0.exr"),
    **{n.split(".")[0]: _of_capture(n) for n in ("journal.jsonl", "plan.json", "manifest.json")},
    "rig": _of_capture("rig.json"),
    **{suffix: _strands(suffix) for suffix in ("npz", "hair", "usda", "usdc")},
    "tfx": _file(
        "strands.tfx",
        struct.pack("<f9I", 4.0, 3, 4, 160, *[0] * 6) + bytes(120) + _floats(48),
        read_strands,
    ),
    "data": _file(
        "strands.data",
        struct.pack("<ii", 2, 4) + _floats(12) + struct.pack("<i", 3) + _floats(9),
        read_strands,
    ),
    "headerless_hair": _file(
        "strands.hair",
        struct.pack("<2I3H", 3, 16, 5, 4, 7) + _floats(48),
        read_strands,
    ),
    "ply_strands": _file("strands.ply", STRANDS_PLY, read_strands),
    "cubic_curves": _file("strands.usda", CUBIC, read_strands),
    "obj": _obj,
    "poses": _numpy(
        "poses.npz", read_poses, points=np.ones((2, 4, 3), np.float32), offsets=np.array([0, 4])
    ),
    "npy": _numpy("scan.npy", read_points, points=np.linspace(-1, 1, 18).reshape(6, 3)),
    "light_array": _numpy("lights.npy", read_lights, lights=np.linspace(1, 2, 6).reshape(2, 3)),
    "mask": _mask,
    **{n.replace(".", "_"): _of_model(n) for n in MODEL},
    "audit": _state("audit.jsonl", ACTION, lambda file: AuditLog(file).latest(9)),
    "tokens": _state("tokens.json", TOKENS, _tokens),
    "queue": _state("queue.json", QUEUE, _queue),
    "latch": _state("unsafe.json", LATCHED, Latch),
    "index": _state("captures.index", INDEX, lambda file: StatusIndex(file).status(file.parent)),
    "faults": _state("faults.json", FAULTS, lambda file: Faults.load(file, ["cam_0"])),
    "settings": _file("import.toml", SETTINGS, read_settings),
    "import_cameras": _state("cameras.json", CAMERAS, cameras_of),
    "import_lights": _state("lights.json", LIGHTS, lambda file: lights_of(file, {0: "cam_00"})),
    "captury": _cameras(writers.write_calib, "camera.calib"),
    "ply": _file("scan.ply", PLY + _floats(54), read_points),
    "points": _file("scan.csv", b"x,y,z\n0.1,0.2,0.3\n-1,2e-1,.5\n", read_points),
    "lights": _file("lights.csv", b"name,x,y,z\na,0.1,0.2,0.3\nb,-1,2e-1,.5\n", read_lights),
    "lamps": _file(
        "lights.json", b'{"lights": [{"name": "a", "position": [1, 0.5, 2]}]}', read_lights
    ),
    "ies": _file("lamp.ies", IES, read_ies),
    "hdr": _hdr,
    "png": _picture("frame.png", np.uint8),
    "png16": _picture("frame.png", np.uint16),
    "tiff": _picture("frame.tif", np.uint16),
    "jpeg": _picture("frame.jpg", np.uint8),
    "avif": _picture("frame.avif", np.uint8),
    "raw": _raw,
    "colmap": _cameras(writers.write_colmap_text, "sparse", "images.txt"),
    "colmap_lenses": _cameras(writers.write_colmap_text, "sparse", "cameras.txt"),
    "colmap_binary": _cameras(writers.write_colmap_binary, "sparse", "images.bin"),
    "metashape": _cameras(writers.write_metashape, "cameras.xml"),
    "transforms": _cameras(writers.write_transforms, "transforms.json"),
    "easymocap": _cameras(writers.write_easymocap, "calib", "intri.yml"),
    "metashape_rig": _cameras(writers.write_rig, "rig.xml"),
    "opencv": _cameras(writers.write_opencv, "opencv", "cam_0.yml"),
    "toml": _toml,
    "options": _json(
        {
            "name": "light_planes",
            "options": {"seed": 3, "held_out_cameras": ["cam_0"], "fit": {"hair_pixels": 100}},
        },
        PipelineRequest.model_validate,
    ),
    "wish": _json(
        {"lights": ["light_000"], "exposure": {"olat": 0.01}, "rows": {"last": 9}, "rate_hz": 2.5},
        CapturePlan.model_validate,
    ),
}
