"""Captures made elsewhere: a folder of cameras, lights and pictures becomes a `Capture`.

folder/
  cameras.json      {"cameras": [{"id", "width", "height", "K", "R", "t"}, ...]}
  lights.json       {"lights": [{"id", "position", "intensity", "colocated_camera"}, ...]}
  images/<camera>/<light>.exr    radiance under that light alone, W/(sr m²)
  masks/<camera>.png             hair masks, optional
  head.obj                       the head's mesh in the same frame, optional

Conventions are those of `Camera` and `Light`: OpenCV, metres, pixel centres at integers, W/sr. An
`id` may be a string, which then is the name of folder or file, or a number n, which stands for
`cam_0n` and `light_0n` (two digits at least). `colocated_camera` holds a camera's id or null.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from reconstruction.capture.folder import Capture, CaptureError, Step
from reconstruction.capture.import_geometry import Geometry
from reconstruction.capture.writer import CaptureWriter
from reconstruction.containment import is_file_name
from reconstruction.files.exr import read_exr
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lens import Lens
from reconstruction.geometry.lens_models import LensModelCamera
from reconstruction.geometry.lights import Light
from reconstruction.geometry.mesh import Mesh, read_obj
from reconstruction.geometry.placement import resized
from reconstruction.geometry.rig import Rig
from reconstruction.report.report import Progress, silent


class ImportProblem(CaptureError):
    """A folder that cannot be imported; the message names the file and the field."""


def import_folder(
    folder: str | Path,
    out: str | Path,
    progress: Progress = silent,
    geometry: Geometry | None = None,
) -> Capture:
    """Turn `folder` (see the module's docstring) into the capture `out`, a new or empty folder.

    `geometry` stands for the folder's cameras.json, and for lights.json where it has lights;
    pictures through lenses that a rig cannot hold are resampled. The capture's plan is one OLAT
    step per light, at level 1 and an exposure of 1 s. All files are looked for before anything is
    written; nothing is left behind when one is broken.

    Raises `ImportProblem` naming the file and field that are wrong or missing.
    """
    folder, out = Path(folder), Path(out)
    if not folder.is_dir():
        raise ImportProblem(f"{folder}: no such folder")
    if geometry is None:
        geometry = Geometry(_cameras(folder / "cameras.json"))
    lights = geometry.lights or _lights(
        folder / "lights.json", {id_: c.name for id_, c in geometry.cameras.items()}
    )
    cameras = [
        _sized(c, folder / "images" / c.name / f"{lights[0].name}.exr")
        for c in geometry.cameras.values()
    ]
    lenses = {c.name: Lens.of(c) for c in cameras if isinstance(c, LensModelCamera)}
    kept = [lenses[c.name].undistorted if c.name in lenses else c for c in cameras]
    rig = Rig(folder.name, tuple(kept), tuple(lights))
    pictures = {
        (light.name, camera.name): folder / "images" / camera.name / f"{light.name}.exr"
        for light in rig.lights
        for camera in rig.cameras
    }
    absent = [p for p in pictures.values() if not p.is_file()]
    if absent:
        more = f", and {len(absent) - 1} more" if len(absent) > 1 else ""
        raise ImportProblem(f"{absent[0]}: no such file{more}; every camera needs every light")
    masks, head = _masks(folder / "masks", cameras), _head(folder / "head.obj")
    masks |= {n: lens.undistort_mask(masks[n]) for n, lens in lenses.items() if n in masks}
    shot = {c.name: c for c in cameras}

    steps = [Step(i, "olat", 1.0, light=light.name) for i, light in enumerate(rig.lights)]
    plan = {"steps": steps, "imported_from": folder.name}
    writer = CaptureWriter.create(out, rig, plan, masks=masks, head=head)
    try:
        for k, (step, camera) in enumerate([(s, c) for s in steps for c in rig.cameras]):
            path = pictures[str(step.light), camera.name]
            picture = _picture(path, shot[camera.name])
            if camera.name in lenses:
                picture = lenses[camera.name].undistort(picture)
            writer.write_frame(step, camera.name, picture)
            progress("importing pictures", (k + 1) / len(pictures))
        writer.finish("completed", {"imported_from": folder.name})
    except BaseException:
        writer.close()
        shutil.rmtree(out)
        raise
    return Capture(out)


def _entries(path: Path, key: str) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The list of tables under `key`, and the whole document."""
    try:
        data = json.loads(path.read_text())
    except FileNotFoundError:
        raise ImportProblem(f"{path}: no such file") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ImportProblem(f"{path}: not JSON ({error})") from error
    if not isinstance(data, dict) or key not in data:
        raise ImportProblem(f"{path}: the field {key!r} is missing")
    entries = data[key]
    if not isinstance(entries, list) or not entries:
        raise ImportProblem(f"{path}: {key}: expected a list with at least one entry")
    for i, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise ImportProblem(f"{path}: {key}[{i}]: expected an object, got {entry!r}")
    return entries, data


def _take(entry: dict[str, Any], field: str, where: str) -> Any:
    if field not in entry:
        raise ImportProblem(f"{where}: the field {field!r} is missing")
    return entry[field]


def _numbers(entry: dict[str, Any], field: str, shape: tuple[int, ...], where: str) -> Any:
    """A field of finite numbers of the given shape."""
    value = _take(entry, field, where)
    try:
        array = np.asarray(value, dtype=np.float64)
    except (ValueError, TypeError):
        array = np.full(0, np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        raise ImportProblem(f"{where}.{field}: expected {shape} finite numbers, got {value!r}")
    return array


def _count(entry: dict[str, Any], field: str, where: str) -> int:
    value = _take(entry, field, where)
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise ImportProblem(f"{where}.{field}: expected a whole number above 0, got {value!r}")
    return value


def _id(entry: dict[str, Any], prefix: str, where: str) -> tuple[str | int, str]:
    """An entry's id and the name it stands for."""
    value = _take(entry, "id", where)
    if isinstance(value, int) and not isinstance(value, bool) and value >= 0:
        return value, f"{prefix}_{value:02d}"
    if isinstance(value, str) and is_file_name(value):
        return value, value
    raise ImportProblem(f"{where}.id: expected a name or a number >= 0, got {value!r}")


def _cameras(path: Path) -> dict[str | int, Camera]:
    """Cameras by id."""
    out: dict[str | int, Camera] = {}
    for i, entry in enumerate(_entries(path, "cameras")[0]):
        where = f"{path}: cameras[{i}]"
        id_, name = _id(entry, "cam", where)
        if name in [c.name for c in out.values()]:
            raise ImportProblem(f"{where}.id: {id_!r} is there twice")
        width, height = _count(entry, "width", where), _count(entry, "height", where)
        K, R = (_numbers(entry, f, (3, 3), where) for f in ("K", "R"))
        t = _numbers(entry, "t", (3,), where)
        lens = _numbers(entry, "distortion", (5,), where) if "distortion" in entry else np.zeros(5)
        try:
            out[id_] = Camera(name, width, height, K, R, t, distortion=lens)
        except ValueError as error:
            raise ImportProblem(f"{where}: {error}") from error
        if "center" in entry:
            center = _numbers(entry, "center", (3,), where)
            if not np.allclose(center, out[id_].center, atol=1e-4):
                raise ImportProblem(
                    f"{where}.center: {center} is not -Rᵀt = {out[id_].center}; "
                    f"R and t must take the world to the camera"
                )
    return out


def _lights(path: Path, cameras: dict[str | int, str]) -> list[Light]:
    entries, data = _entries(path, "lights")
    for field, unit in (("position", "m"), ("intensity", "W/sr")):
        units = data.get("units", {})
        given = units.get(field, unit) if isinstance(units, dict) else units
        if given != unit:
            raise ImportProblem(f"{path}: units.{field}: expected {unit!r}, got {given!r}")
    out: list[Light] = []
    for i, entry in enumerate(entries):
        where = f"{path}: lights[{i}]"
        id_, name = _id(entry, "light", where)
        if name in [light.name for light in out]:
            raise ImportProblem(f"{where}.id: {id_!r} is there twice")
        position, intensity = (_numbers(entry, f, (3,), where) for f in ("position", "intensity"))
        if (intensity < 0).any():
            raise ImportProblem(f"{where}.intensity: must not be negative, got {intensity}")
        beside = entry.get("colocated_camera")
        if beside is not None and (not isinstance(beside, str | int) or beside not in cameras):
            raise ImportProblem(
                f"{where}.colocated_camera: no camera has the id {beside!r}; "
                f"there are {list(cameras)}"
            )
        out.append(Light(name, position, intensity, None if beside is None else cameras[beside]))
    return out


def _sized(camera: Camera, picture: Path) -> Camera:
    """`camera` for the size that `picture` has; as it is where there is none."""
    try:
        height, width = read_exr(picture)[0].shape[:2] if picture.is_file() else (0, 0)
        return resized(camera, width, height) if width else camera
    except ValueError as error:
        raise ImportProblem(f"{picture}: {error}") from error


def _masks(folder: Path, cameras: list[Camera]) -> dict[str, NDArray[Any]]:
    """The masks that are there, half grey and above."""
    out: dict[str, NDArray[Any]] = {}
    for camera in cameras:
        path = folder / f"{camera.name}.png"
        if not path.is_file():
            continue
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        found = None if image is None else image.shape
        if found != (camera.height, camera.width):
            raise ImportProblem(
                f"{path}: expected a PNG of {(camera.height, camera.width)} pixels, got {found}"
            )
        out[camera.name] = np.asarray(image) >= 128
    return out


def _head(path: Path) -> Mesh | None:
    try:
        return read_obj(path) if path.is_file() else None
    except ValueError as error:
        raise ImportProblem(str(error)) from error


def _picture(path: Path, camera: Camera) -> Floats:
    try:
        image, _ = read_exr(path)
    except ValueError as error:
        raise ImportProblem(str(error)) from error
    if image.shape != (camera.height, camera.width, 3):
        raise ImportProblem(
            f"{path}: {image.shape[1]}x{image.shape[0]} pixels, cameras.json gives {camera.name} "
            f"{camera.width}x{camera.height}"
        )
    if not np.isfinite(image).all():
        raise ImportProblem(f"{path}: has pixels that are not finite numbers")
    return image
