"""Reads files of a format, each damaged in another way, in a process of its own.

`python mutate.py FORMAT COUNT FOLDER` prints a line of JSON a file that was not read or refused as
it should be, and at the end one with what became of all. It is a process because a reader may end
it, hang, or take the machine's memory.
"""

from __future__ import annotations

import json
import re
import resource
import shutil
import signal
import struct
import sys
import tomllib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import camera_writers as writers
import cv2
import numpy as np
from dng_writer import write_dng

from appearance.render.environment_maps import load_environment
from reconstruction import (
    Camera,
    Capture,
    CaptureWriter,
    Light,
    Rig,
    Step,
    Strands,
    read_obj,
    read_strands,
    verify,
    write_strands,
)
from reconstruction.files.cameras import read_cameras
from reconstruction.files.exr import read_exr, write_exr
from reconstruction.files.lights import read_lights
from reconstruction.files.pictures import Sensor, read_picture
from reconstruction.files.points import read_points
from reconstruction.geometry.ies import read_ies
from reconstruction.reading import parse_json
from stage_service.acquisition.states import read_status
from stage_service.config import load_rig_file
from stage_service.jobs.records import PipelineRequest
from stage_service.plan.capture_plan import CapturePlan

SECONDS = 5
MOST_BYTES = 1 << 30
REFUSED = (ValueError, OSError)
WORDS = (b"-1", b"0", b"1e999", b"NaN", b"99999999999999999999", b"null", b'""', b"[]", b"{}", b"x")
"""In the place of numbers, where the file is text."""
INTERESTING = (b"\xff\xff\xff\xff", b"\x00\x00\x00\x80", b"\x7f\xff\xff\xff", b"\0" * 8, b"1e999")


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """`data` with some bytes flipped, cut, doubled, moved or replaced by what breaks sums."""
    out = bytearray(data)
    if data.isascii() and rng.random() < 0.5:
        numbers = list(re.finditer(rb"[-+.\deE]*\d", data))
        where = numbers[rng.integers(len(numbers))]
        out[where.start() : where.end()] = WORDS[rng.integers(len(WORDS))]
        return bytes(out)
    for _ in range(rng.integers(1, 5)):
        at, n = int(rng.integers(len(out) + 1)), int(rng.integers(1, 40))
        match rng.integers(7):
            case 0:
                out[at : at + 1] = bytes([rng.integers(256)])
            case 1:
                del out[at:]
            case 2:
                del out[at : at + n]
            case 3:
                out[at:at] = out[at : at + n] * int(rng.integers(1, 200))
            case 4:
                value = INTERESTING[rng.integers(len(INTERESTING))]
                out[at : at + len(value)] = value
            case 5:
                out[at:at] = rng.bytes(n)
            case _:
                if at < len(out):
                    out[at] ^= 1 << int(rng.integers(8))
    return bytes(out)


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
    "obj": _obj,
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


def main(name: str, count: int, folder: Path) -> None:
    file, read = FORMATS[name](folder)
    whole, rng = file.read_bytes(), np.random.default_rng(len(name))
    read(file)  # whole, it is read

    def late(*_: object) -> None:
        raise TimeoutError(f"not within {SECONDS} s")

    signal.signal(signal.SIGALRM, late)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST_BYTES, used + MOST_BYTES))
    told: Counter[str] = Counter()
    for number in range(count):
        file.write_bytes(bad := damaged(whole, rng))
        print(json.dumps({"at": number}), flush=True)
        signal.alarm(SECONDS)
        try:
            read(file)
            told["read"] += 1
        except TimeoutError as error:
            print(json.dumps({"wrong": number, "why": str(error), "file": bad[:200].hex()}))
        except REFUSED:
            told["refused"] += 1
        except BaseException as error:
            why = f"{type(error).__name__}: {error}"
            print(json.dumps({"wrong": number, "why": why[:300], "file": bad[:200].hex()}))
        finally:
            signal.alarm(0)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(json.dumps({"told": told, "peak_bytes": peak}))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3]))
