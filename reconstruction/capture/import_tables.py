"""cameras.json, lights.json, projectors.json, head.obj and scalp.obj of a folder to import."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from reconstruction.arrays import Array
from reconstruction.capture.import_geometry import (
    Geometry,
    GeometryFiles,
    checked,
    place_lights,
)
from reconstruction.capture.import_settings import ImportProblem
from reconstruction.containment import is_file_name
from reconstruction.files.lights import lobe, read_lights
from reconstruction.files.points import read_points
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lights import Light
from reconstruction.geometry.mesh import Mesh, read_obj
from reconstruction.geometry.placement import (
    FURTHEST,
    NEAREST,
    PARALLEL,
    PlacementError,
    PlacementOptions,
    Sight,
    Unit,
    length,
    placed,
    placed_lights,
)
from reconstruction.geometry.projectors import Projector
from reconstruction.geometry.rig import Rig, RigError
from reconstruction.geometry.world_frame import WorldFrame
from reconstruction.reading import read_json

INSIDE = 0.05
"""Metres from the cameras' common target at which there is the subject and no light."""
SMALLEST, LARGEST = 0.03, 2.5
"""Metres: extent of a part of a scalp, and of a head with its body."""


def _entries(path: Path, key: str) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The list of tables under `key`, and the whole document."""
    try:
        data = read_json(path)
    except FileNotFoundError:
        raise ImportProblem(f"{path}: no such file") from None
    except ValueError as error:
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
    """An entry's id and name."""
    value = _take(entry, "id", where)
    if isinstance(value, int) and not isinstance(value, bool) and value >= 0:
        return value, f"{prefix}_{value:02d}"
    if isinstance(value, str) and is_file_name(value):
        return value, value
    raise ImportProblem(f"{where}.id: expected a name or a number >= 0, got {value!r}")


def cameras_of(path: Path) -> dict[str | int, Camera]:
    """Cameras by id."""
    out: dict[str | int, Camera] = {}
    for i, entry in enumerate(_entries(path, "cameras")[0]):
        where = f"{path}: cameras[{i}]"
        id_, name = _id(entry, "cam", where)
        if name in [c.name for c in out.values()]:
            raise ImportProblem(f"{where}.id: duplicate {id_!r}")
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


def lights_of(path: Path, cameras: dict[str | int, str], length: Unit = "m") -> list[Light]:
    """Lights in the file's unit, `length`, none without the file; `cameras` are names by id, for
    `colocated_camera`."""
    if not path.is_file():
        return []
    entries, data = _entries(path, "lights")
    for field, unit in (("position", length), ("intensity", "W/sr")):
        units = data.get("units", {})
        given = units.get(field, unit) if isinstance(units, dict) else units
        if given != unit:
            raise ImportProblem(f"{path}: units.{field}: expected {unit!r}, got {given!r}")
    out: list[Light] = []
    for i, entry in enumerate(entries):
        where = f"{path}: lights[{i}]"
        id_, name = _id(entry, "light", where)
        if name in [light.name for light in out]:
            raise ImportProblem(f"{where}.id: duplicate {id_!r}")
        position, intensity = (_numbers(entry, f, (3,), where) for f in ("position", "intensity"))
        if (intensity < 0).any():
            raise ImportProblem(f"{where}.intensity: must not be negative, got {intensity}")
        beside = entry.get("colocated_camera")
        if beside is not None and (not isinstance(beside, str | int) or beside not in cameras):
            raise ImportProblem(
                f"{where}.colocated_camera: no camera has the id {beside!r}; "
                f"there are {list(cameras)}"
            )
        camera = None if beside is None else cameras[beside]
        try:
            out.append(Light(name, position, intensity, camera, **lobe(entry, where)))
        except ValueError as error:
            raise ImportProblem(str(error)) from error
    return out


def own_geometry(
    folder: Path, placement: PlacementOptions, files: GeometryFiles | None = None
) -> Geometry:
    """The folder's cameras.json, and its lights.json or the lights of `files`, placed.

    Without a placement they are in metres with z up, and doubts are notes. Raises `ImportProblem`
    naming the file.
    """
    path, default = folder / "cameras.json", placement == PlacementOptions()
    read = cameras_of(path)
    names = {id_: c.name for id_, c in read.items()}
    cameras = list(read.values())
    if not default:
        cameras = placed(cameras, placement, "opencv")
        read = dict(zip(read, cameras, strict=True))
    more: list[str] = []
    if files is not None and files.lights is not None:
        found = read_lights(files.lights)
        lights, more = place_lights(files, found, cameras)
        more = [*found.notes, *more]
    else:
        lights = lights_of(folder / "lights.json", names, placement.light_unit or placement.unit)
        lights = lights if default else placed_lights(lights, placement)
    try:
        notes = checked(path, list(read.values()), placement, "opencv")
    except PlacementError as error:
        if not default:
            raise ImportProblem(str(error)) from error
        doubts = [] if str(error).endswith(PARALLEL) else [str(error)]
        return Geometry(read, lights, [*doubts, *more])
    return Geometry(read, lights, [*([] if default else notes), *more], placement)


def projectors_of(path: Path) -> tuple[Projector, ...]:
    """Projectors, none without the file."""
    if not path.is_file():
        return ()
    entries = _entries(path, "projectors")[0]
    anything = {"id": 0, "name": "any", "width": 1, "height": 1, "K": np.eye(3), "R": np.eye(3)}
    camera = {**anything, "t": [0, 0, 1]}
    camera.pop("id")
    try:
        return Rig.from_dict({"cameras": [camera], "projectors": entries}).projectors
    except (RigError, ValueError, TypeError, LookupError) as error:
        raise ImportProblem(f"{path}: {error}") from error


def check_metres(folder: Path, rig: Rig, *own: str) -> None:
    """Raise `ImportProblem` if the folder's `own` files ("cameras", "lights") are not in metres.

    That is, if the median distance from the point that the cameras look at is implausible. Also
    for a light inside the subject.
    """
    try:
        sight = Sight.of(rig.cameras)
    except PlacementError:
        return
    lights = np.array([x.position for x in rig.lights]).reshape(-1, 3)
    far = {"cameras": sight.distance, "lights": np.linalg.norm(lights - sight.point, axis=1)}
    for kind in filter(None, own):
        distance = float(np.median(far[kind]))
        if sight.whole and not NEAREST <= distance <= FURTHEST:
            raise ImportProblem(
                f"{folder / kind}.json: the {kind} are {length(distance)} from the point that the "
                f"cameras look at, expected {NEAREST} to {FURTHEST} m: give --unit (mm, cm, inch "
                "or its length in metres), or metres"
            )
    near = [x.name for x in rig.lights if np.linalg.norm(x.position - sight.point) < INSIDE]
    if near and sight.whole:
        raise ImportProblem(
            f"{folder}: {', '.join(near[:8])}: within {100 * INSIDE:g} cm of the point that the "
            "cameras look at, inside the subject: check the lights' positions and unit "
            "(--light-unit)"
        )


def _check_size(path: Path, points: Array) -> None:
    """Raise `ImportProblem` if `points (N, 3)` of a head or a part of one are not in metres."""
    wide = float(np.ptp(points, axis=0).max())
    if not SMALLEST <= wide <= LARGEST:
        raise ImportProblem(
            f"{path}: is {length(wide)} wide, expected {SMALLEST} to {LARGEST} m: give metres with "
            "z up"
        )


def _in_metres(path: Path, points: Array, world: WorldFrame) -> bool:
    """Whether `points (N, 3)` are in metres with z up rather than in the user's `world`.

    They are if only then their size is a head's. Raises `ImportProblem` if it never is.
    """
    wide = world.unit * float(np.ptp(points, axis=0).max())
    if SMALLEST <= wide <= LARGEST:
        return False
    _check_size(path, points)
    return True


def head_of(path: Path, world: WorldFrame) -> Mesh | None:
    """The mesh of head.obj in metres with z up, None without the file."""
    if not path.is_file():
        return None
    try:
        head = read_obj(path)
    except ValueError as error:
        raise ImportProblem(str(error)) from error
    return head if _in_metres(path, head.vertices, world) else world.inputs(head)


def scalp_of(path: Path, world: WorldFrame) -> str | None:
    """The text of a readable file of points in metres with z up, None without the file."""
    if not path.is_file():
        return None
    try:
        points, _ = read_points(path)
    except ValueError as error:
        raise ImportProblem(str(error)) from error
    text = path.read_text()
    return text if _in_metres(path, points, world) else obj_in_stage(text, world)


def obj_in_stage(text: str, world: WorldFrame) -> str:
    """The text of an OBJ in the user's `world`, in the stage's frame."""
    if world.same:
        return text
    turn = WorldFrame(1.0, world.up)
    frames = {"v": world, "vn": turn}

    def placed(line: str) -> str:
        words = line.split()
        if not words or words[0] not in frames:
            return line
        moved = frames[words[0]].to_stage(np.array(words[1:4], float))
        return " ".join([words[0], *(f"{x:.9g}" for x in moved), *words[4:]]) + "\n"

    return "".join(placed(line) for line in text.splitlines(keepends=True))
