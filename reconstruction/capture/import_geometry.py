"""Cameras and lights of an imported capture: read, converted to the world frame, checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from pydantic import Field

from reconstruction.files.cameras import read_cameras
from reconstruction.files.cameras.errors import CameraAxes
from reconstruction.files.lights import LightFile, from_directions, read_lights
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lights import Light
from reconstruction.geometry.placement import (
    FURTHEST,
    PlacementError,
    PlacementOptions,
    Sight,
    Unit,
    check_cameras,
    check_lights,
    metres,
    placed,
    placed_lights,
)
from reconstruction.options import options


@dataclass(frozen=True)
class Geometry:
    """Cameras by their id in the file, and lights, in the world frame; `notes` for the user.

    `placement` leads from the files' world to that frame.
    """

    cameras: Mapping[str | int, Camera]
    lights: list[Light] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    placement: PlacementOptions = field(default_factory=PlacementOptions)


@options
class GeometryFiles:
    """The user's files of cameras and lights, and their placement.

    `light_distance` in metres applies to lights given as directions.
    """

    cameras: Path | None = None
    lights: Path | None = None
    light_distance: Annotated[float, Field(gt=0, le=FURTHEST)] | None = None
    placement: PlacementOptions = PlacementOptions()


CAMERA_FILES = (
    *("sparse/0", "sparse", "transforms.json", "cameras.xml"),
    *("intri.yml", "calib/intri.yml"),
)
LIGHT_FILES = ("lights.csv", "lights.txt", "lights.npy", "lights.mat")
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".r3d")


def files_in(folder: Path, given: GeometryFiles) -> GeometryFiles:
    """`given` with paths in `folder`, completed by the first of `CAMERA_FILES` and `LIGHT_FILES`.

    The folder's own cameras.json and lights.json take precedence over the latter. Without a file of
    lights the photographs are taken as under constant light. Raises `PlacementError` if there is no
    file of cameras.
    """
    cameras, lights = (None if p is None else folder / p for p in (given.cameras, given.lights))
    if cameras is None and folder.is_dir() and not (folder / "cameras.json").is_file():
        cameras = next((p for n in CAMERA_FILES if (p := folder / n).exists()), None)
        if cameras is None:
            if video := next((p for p in folder.rglob("*") if p.suffix.lower() in VIDEOS), None):
                raise PlacementError(
                    f"{video}: videos are not read: extract its frames, and solve their cameras "
                    "with COLMAP"
                )
            raise PlacementError(
                f"{folder}: no file of cameras: give --cameras (a COLMAP folder, transforms.json, "
                "a Metashape, OpenCV or EasyMocap file) or add cameras.json"
            )
    if cameras is not None and lights is None and not (folder / "lights.json").is_file():
        lights = next((p for n in LIGHT_FILES if (p := folder / n).exists()), None)
    return replace(given, cameras=cameras, lights=lights)


def read_geometry(files: GeometryFiles) -> Geometry:
    """Read, place and check; empty without files.

    Raises `ValueError` naming the file and the option that would correct it.
    """
    cameras: list[Camera] = []
    notes: list[str] = []
    if files.cameras is None and files.lights is not None:
        raise PlacementError(
            "--lights requires --cameras; with cameras.json the lights are read from lights.json"
        )
    if (path := files.cameras) is not None:
        read = read_cameras(path)
        if read.metres is not None and metres(files.placement.unit) != read.metres:
            if files.placement.unit == "m":
                files = replace(files, placement=replace(files.placement, unit=read.metres))
            else:
                notes.append(_two_units(path, read.metres, "--unit", files.placement.unit))
        cameras = placed(read.cameras, files.placement, read.axes)
        notes += read.notes
        if read.unitless:
            unit = files.placement.unit
            length = unit if isinstance(unit, str) else f"{unit:g} m"
            notes.append(f"{path} has no unit: {length} is assumed (--unit)")
        notes += checked(path, cameras, files.placement, read.axes)
    lights: list[Light] = []
    if files.lights is not None:
        found = read_lights(files.lights)
        lights, more = place_lights(files, found, cameras)
        notes += found.notes + more
    return Geometry({c.name: c for c in cameras}, lights, notes, files.placement)


def checked(
    path: Path, cameras: list[Camera], placement: PlacementOptions, axes: CameraAxes
) -> list[str]:
    """The notes of `check_cameras`; its error names the file `path`."""
    try:
        return check_cameras(cameras, placement, axes)
    except PlacementError as error:
        raise PlacementError(f"{path}: {error}") from error


def _two_units(path: Path | None, stated: float, option: str, given: Unit) -> str:
    return f"{path}: states a unit of {stated:g} m, {option} is {metres(given):g} m, which is used"


def place_lights(
    files: GeometryFiles, found: LightFile, cameras: list[Camera]
) -> tuple[list[Light], list[str]]:
    """The lights `found` in a file, placed, and notes. Raises `PlacementError`."""
    where, lights, directions = files.placement, found.lights, found.directions
    notes: list[str] = []
    if found.metres is not None:
        given = where.light_unit
        if given is not None and metres(given) != found.metres:
            notes.append(_two_units(files.lights, found.metres, "--light-unit", given))
        where = replace(where, light_unit=found.metres if given is None else given)
    names = [c.name for c in cameras]
    for light in lights:
        if light.beside is not None and light.beside not in names:
            raise PlacementError(
                f"{files.lights}: {light.name}: colocated_camera: no camera "
                f"{light.beside!r}; there are {', '.join(names)}"
            )
    if files.light_distance is not None:
        if not directions:
            raise PlacementError(
                f"{files.lights}: --light-distance applies to directions (length 1), not positions"
            )
        turned = placed_lights(lights, PlacementOptions(up=where.up))
        center = Sight.of(cameras).point
        return from_directions(turned, center, files.light_distance), []
    out = placed_lights(lights, where)
    try:
        check_lights(cameras, out, where.light_unit or where.unit)
    except PlacementError as error:
        raise PlacementError(f"{files.lights}: {error}") from error
    if not directions:
        return out, notes
    return out, [
        *notes,
        f"{files.lights}: all lights are at distance 1 from the origin and are read as positions; "
        "if they are directions, give --light-distance",
    ]
