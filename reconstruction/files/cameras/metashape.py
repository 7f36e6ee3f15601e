"""Metashape's exported cameras, `.xml` (Metashape manual, "Camera models"; Export Cameras).

A camera's transform maps camera (x right, y down, z forward) to chunk; the component's or the
chunk's maps that to the world: X = scale · R x + t. In a rig, the rotation and location of a
sensor map its cameras to their master. The corner of the top-left pixel is at (0, 0);
cx and cy are relative to the image centre.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from reconstruction.arrays import Array
from reconstruction.files.cameras.errors import (
    CameraFile,
    CameraFileError,
    camera_names,
    camera_of,
    pinhole_K,
)
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lens_models import LensModel

Element = ElementTree.Element
_LENS = ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
_FISHEYE = ("k1", "k2", "k3", "k4")
_UNIT = re.compile(r'UNIT\["([^"]*)",\s*([0-9.eE+-]+)\s*\]')


def read_metashape(path: Path, root: Element) -> CameraFile:
    """The aligned cameras of the only chunk; `notes` list the others.

    Raises `CameraFileError` naming the element.
    """
    chunks = root.findall("chunk") or ([root] if root.tag == "chunk" else [])
    if len(chunks) != 1:
        raise CameraFileError(
            f"{path}: expected one chunk, got {len(chunks)}: export a single chunk"
        )
    chunk = chunks[0]
    sensors = {s.get("id"): s for s in chunk.iterfind("sensors/sensor")}
    components = {c.get("id"): c.find("transform") for c in chunk.iterfind("components/component")}
    notes, metres = _unit(path, chunk)
    every = chunk.findall("cameras//camera")
    by_id = {c.get("id"): c for c in every}
    posed: list[tuple[Element, Element]] = []
    left: dict[str, list[str]] = {}
    for camera in every:
        master = camera
        if camera.find("transform") is None:  # of a rig
            master = by_id.get(camera.get("master_id"), camera)
        if camera.get("enabled") in ("false", "0"):
            left.setdefault("disabled", []).append(camera.get("label", "?"))
        elif master.find("transform") is None:
            left.setdefault("not aligned", []).append(camera.get("label", "?"))
        else:
            posed.append((camera, master))
    if not posed:
        raise CameraFileError(
            f"{path}: no camera is aligned (has a transform): align cameras first"
        )
    worlds = {m.get("component_id") for _, m in posed}
    alone = {w for w in worlds if components.get(w) is None and w in components}
    if len(worlds) > 1 and alone:
        active = chunk.find("components").get("active_id")  # type: ignore[union-attr]
        kept = active if active in worlds else posed[0][1].get("component_id")
        left[f"in another component than {kept}, without a transform to it"] = [
            c.get("label", "?") for c, m in posed if m.get("component_id") != kept
        ]
        posed = [(c, m) for c, m in posed if m.get("component_id") == kept]
    elif len(worlds) > 1:
        notes.append(f"{path}: {len(worlds)} components, each placed by its own transform")
    notes += [f"{path}: {why}, skipped: {', '.join(names)}" for why, names in left.items()]
    names = camera_names([c.get("label", "") for c, _ in posed], str(path))
    cameras = []
    scaled = False
    for (element, master), name in zip(posed, names, strict=True):
        where = f"{path}: camera {name}"
        sensor = sensors.get(element.get("sensor_id"))
        if sensor is None:
            raise CameraFileError(f"{where}: there is no sensor {element.get('sensor_id')!r}")
        world = components.get(master.get("component_id"))
        world = world if world is not None else chunk.find("transform")
        scaled |= world is not None and world.find("scale") is not None
        pose = _matrix(master, where)
        if master is not element:
            if sensor.find("rotation") is None and sensor.find("location") is None:
                notes.append(f"{where}: its sensor has no offset, it is placed at its rig's master")
            offset = np.eye(4)
            offset[:3, :3] = _inner(sensor, "rotation", 9, np.eye(3), where).reshape(3, 3)
            offset[:3, 3] = _inner(sensor, "location", 3, np.zeros(3), where)
            pose = pose @ offset
        if element.findtext("orientation", "1").strip() != "1":
            notes.append(
                f"{where}: its photographs have the orientation {element.findtext('orientation')}, "
                "its calibration is of pixels that are not turned by it"
            )
        cameras.append(_camera(where, name, sensor, pose, world))
    if not scaled:
        notes.append(f"{path}: the chunk has no scale: its unit is arbitrary")
    return CameraFile(cameras, notes, metres)


def _unit(path: Path, chunk: Element) -> tuple[list[str], float | None]:
    reference = chunk.findtext("reference", "")
    if reference.startswith(("GEOGCS", "GEOCCS", "PROJCS")):
        raise CameraFileError(
            f"{path}: geographic coordinates ({reference[:40]}…): export in local coordinates"
        )
    found = _UNIT.search(reference)
    if not found:
        return [], None
    name, value = found[1].lower(), float(found[2])
    if name.startswith("milli") and value == 1:  # of scripts that scale by 1000
        value = 0.001
    return [f"{path}: unit of the reference: {found[1]}"], value


def _numbers(text: str | None, count: int, where: str) -> Array:
    try:
        values = np.array([float(w) for w in (text or "").split()])
    except ValueError as error:
        raise CameraFileError(f"{where}: {error}") from error
    if len(values) != count or not np.isfinite(values).all():
        raise CameraFileError(f"{where}: expected {count} finite numbers, got {text!r}")
    return values


def _value(element: Element, tag: str, where: str, default: float | None = 0.0) -> float:
    text = element.findtext(tag)
    if text is None and default is not None:
        return default
    return float(_numbers(text, 1, f"{where}: <{tag}>")[0])


def _calibration(sensor: Element) -> Element | None:
    found = {c.get("class"): c for c in sensor.iterfind("calibration")}
    return found.get("adjusted", found.get("initial", next(iter(found.values()), None)))


def _matrix(element: Element, where: str) -> Array:
    pose = _numbers(element.findtext("transform"), 16, f"{where}: <transform>").reshape(4, 4)
    if not np.allclose(pose[3], (0, 0, 0, 1), atol=1e-6):
        raise CameraFileError(f"{where}: <transform>: expected a last row of 0 0 0 1")
    return pose


def _camera(where: str, name: str, sensor: Element, pose: Array, world: Element | None) -> Camera:
    calibration = _calibration(sensor)
    if calibration is None:
        raise CameraFileError(f"{where}: its sensor has no calibration")
    kind = calibration.get("type", sensor.get("type", "frame"))
    if kind not in ("frame", "equidistant_fisheye", "fisheye"):
        raise CameraFileError(f"{where}: expected a frame or fisheye camera, got {kind}")
    size = _size(where, calibration, sensor)
    f, b1, b2 = (_value(calibration, t, where, d) for t, d in (("f", None), ("b1", 0), ("b2", 0)))
    cx = _value(calibration, "cx", where) + size[0] / 2
    cy = _value(calibration, "cy", where) + size[1] / 2
    fisheye = kind != "frame"
    if fisheye and (any(_value(calibration, t, where) for t in ("p1", "p2"))):
        raise CameraFileError(f"{where}: a fisheye with p1, p2 is not supported: fix them to 0")
    values = [_value(calibration, t, where) for t in (_FISHEYE if fisheye else _LENS)]
    lens = LensModel("fisheye" if fisheye else "metashape", np.array(values))
    R, center = pose[:3, :3], pose[:3, 3]
    if world is not None:
        turn = _inner(world, "rotation", 9, np.eye(3), where).reshape(3, 3)
        scale = float(_inner(world, "scale", 1, np.ones(1), where)[0])
        R = turn @ R
        center = scale * turn @ center + _inner(world, "translation", 3, np.zeros(3), where)
    K = pinhole_K(f + b1, f, cx, cy, b2)
    return camera_of(where, name, size, K, (R.T, -R.T @ center), lens)


def _inner(world: Element, tag: str, count: int, default: Array, where: str) -> Any:
    text = world.findtext(tag)
    return default if text is None else _numbers(text, count, f"{where}: <{tag}>")


def _size(where: str, calibration: Element, sensor: Element) -> tuple[int, int]:
    for owner in (calibration, sensor):
        found = owner.find("resolution")
        if found is not None:
            width, height = (found.get(k, "") for k in ("width", "height"))
            if width.isdecimal() and height.isdecimal():
                return int(width), int(height)
    raise CameraFileError(f"{where}: <resolution> must have a width and a height")
