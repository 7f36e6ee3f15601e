"""The calibrated geometry of a stage, read from a rig file."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from reconstruction.containment import inside, is_file_name, plain_file
from reconstruction.geometry.cameras import Camera, Pinhole, facing
from reconstruction.geometry.ies import read_ies
from reconstruction.geometry.light_profiles import LightProfile
from reconstruction.geometry.lights import Light, dome_positions
from reconstruction.geometry.projectors import Projector
from reconstruction.reading import parse_json

P = TypeVar("P", bound=Pinhole)


class RigError(ValueError):
    """A rig file that cannot be used; the message names the file, the table and the field."""


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras, lights and projectors of one stage, in one world frame (metres, z up)."""

    name: str
    cameras: tuple[Camera, ...]
    lights: tuple[Light, ...]
    projectors: tuple[Projector, ...] = ()

    def __post_init__(self) -> None:
        for kind in ("cameras", "lights", "projectors"):
            names = [item.name for item in getattr(self, kind)]
            twice = {n for n in names if names.count(n) > 1}
            if twice:
                raise RigError(f"rig {self.name}: {kind} must have distinct names, twice: {twice}")
            for name in names:
                if not is_file_name(name):
                    shown = repr(name)[:60]
                    raise RigError(f"{kind}: {shown} cannot be a name: files are named by it")
        kept = self.profiles
        for profile in (x.profile for x in self.lights if x.profile is not None):
            if kept[profile.name] is not profile:
                raise RigError(f"rig {self.name}: two profiles are named {profile.name!r}")

    @property
    def profiles(self) -> dict[str, LightProfile]:
        """The profiles of the lights, by name."""
        return {x.profile.name: x.profile for x in self.lights if x.profile is not None}

    def camera(self, name: str) -> Camera:
        """The camera called `name`; KeyError lists the names."""
        return _named(self.cameras, name, "camera")

    def light(self, name: str) -> Light:
        """The light called `name`; KeyError lists the names."""
        return _named(self.lights, name, "light")

    def projector(self, name: str) -> Projector:
        """The projector called `name`; KeyError lists the names."""
        return _named(self.projectors, name, "projector")

    @classmethod
    def load(cls, path: str | Path) -> Rig:
        """Read a rig from TOML (explicit devices, `look_at` poses, domes) or from JSON.

        Raises `RigError` naming file, table and field when something is missing or wrong.
        """
        path = Path(path)
        try:
            text = plain_file(path).read_bytes()
            data = parse_json(text) if path.suffix == ".json" else tomllib.loads(text.decode())
        except FileNotFoundError:
            raise RigError(
                f"{path}: no such rig file; give the path of a .toml or .json file"
            ) from None
        except ValueError as error:
            raise RigError(f"{path}: {error}") from error
        if not isinstance(data, dict):
            raise RigError(f"{path}: expected an object, got {type(data).__name__}")
        try:
            return cls.from_dict(data, path.parent)
        except (ValueError, TypeError, LookupError, AttributeError, OverflowError) as error:
            raise RigError(f"{path}: {error}") from error

    @classmethod
    def from_dict(cls, data: dict[str, Any], folder: Path = Path()) -> Rig:
        """Build a rig from the tables of a rig file; device tables are ignored.

        Files that it names, such as IES profiles, are relative to `folder`.
        """
        cameras = tuple(_pinholes(Camera, data, "cameras"))
        if not cameras:
            raise RigError("a rig needs at least one [[cameras]] table")
        projectors = tuple(_pinholes(Projector, data, "projectors"))
        lights = tuple(_lights(data, cameras, _profiles(data, folder)))
        return cls(str(data.get("name", "rig")), cameras, lights, projectors)

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready description with every pose explicit; `from_dict` reads it back exactly."""
        profiles = {"profiles": {k: p.to_dict() for k, p in self.profiles.items()}}
        return {
            **(profiles if self.profiles else {}),
            "name": self.name,
            "cameras": [c.to_dict() for c in self.cameras],
            "lights": [light.to_dict() for light in self.lights],
            "projectors": [p.to_dict() for p in self.projectors],
        }


T = TypeVar("T", Camera, Light, Projector)


def _named(items: tuple[T, ...], name: str, kind: str) -> T:
    for item in items:
        if item.name == name:
            return item
    raise KeyError(f"no {kind} {name!r} in this rig; {counted([i.name for i in items])}")


def counted(names: Sequence[str]) -> str:
    """The number of `names` and a list, of many the first and the last three."""
    some = names if len(names) <= 12 else [*names[:3], "…", *names[-3:]]
    return f"its {len(names)} are {', '.join(some)}" if names else "it has none"


def _take(table: dict[str, Any], where: str, *fields: str) -> list[Any]:
    if missing := [f for f in fields if f not in table]:
        raise RigError(f"{where}: the field {missing[0]!r} is missing")
    return [table[f] for f in fields]


def _refuse_others(table: dict[str, Any], known: set[str], where: str) -> None:
    if unknown := set(table) - known:
        raise RigError(f"{where}: unknown fields {sorted(unknown)}; known are {sorted(known)}")


_DOME_FIELDS = {
    *("lights", "intensity", "radius", "lowest_deg", "beside_cameras_at"),
    *("profile", "size", "roll_deg", "light_radius"),
}

_OWN_FIELDS: dict[type[Pinhole], tuple[str, ...]] = {
    Camera: ("distortion", "filter_sigma"),
    Projector: ("intensity", "line_sigma"),
}


def _pinholes(kind: type[P], data: dict[str, Any], key: str) -> list[P]:
    """Pinholes from explicit `K, R, t` or from `position, target, fov_deg[, roll_deg]`."""
    out: list[P] = []
    for i, table in enumerate(data.get(key, [])):
        where = f"[[{key}]] number {i + 1} ({table.get('name', 'unnamed')})"
        name, width, height = _take(table, where, "name", "width", "height")
        own = _OWN_FIELDS[kind]
        more: dict[str, Any] = {f: table[f] for f in own if f in table}
        explicit, placed = ("K", "R", "t"), ("position", "target", "fov_deg")
        _refuse_others(
            table, {*("name", "width", "height"), *explicit, *placed, "roll_deg", *own}, where
        )
        pose = _take(table, where, *(explicit if "K" in table else placed))
        make: Any = kind if "K" in table else kind.look_at
        if "K" not in table and "roll_deg" in table:
            more["roll_deg"] = float(table["roll_deg"])
        try:
            out.append(make(str(name), int(width), int(height), *pose, **more))
        except (ValueError, TypeError) as error:
            raise RigError(f"{where}: {error}") from error
    return out


def _profiles(data: dict[str, Any], folder: Path) -> dict[str, LightProfile]:
    """`[profiles.NAME]`: an IES `file` with a `unit`, or the table of `LightProfile.to_dict`."""
    out = {}
    for name, table in data.get("profiles", {}).items():
        where = f"[profiles.{name}]"
        try:
            if "file" not in table:
                out[name] = LightProfile(**{**table, "name": name})
                continue
            if unknown := set(table) - {"file", "unit", "tilt_deg"}:
                raise RigError(f"unknown fields {sorted(unknown)}")
            unit = table.get("unit")
            of_file = None if unit == "relative" else unit
            profile = read_ies(
                plain_file(inside(folder, table["file"])),
                unit=of_file,
                tilt_deg=float(table.get("tilt_deg", 0.0)),
            )
            profile = profile.relative() if unit == "relative" else profile
            out[name] = replace(profile, name=name)
        except (OSError, ValueError, TypeError) as error:
            raise RigError(f"{where}: {error}") from error
    return out


_LIGHT_FIELDS = {
    *("name", "position", "intensity", "beside"),
    *("orientation", "aim", "roll_deg", "profile", "radius", "size"),
}


def _light(table: dict[str, Any], where: str, profiles: dict[str, LightProfile]) -> Light:
    """A light; `aim` (a direction) and `roll_deg` stand for `orientation`."""
    _refuse_others(table, _LIGHT_FIELDS, where)
    required = _take(table, where, "name", "position", "intensity")
    own = ("beside", "orientation", "radius", "size")
    more: dict[str, Any] = {f: table[f] for f in own if f in table}
    if "profile" in table:
        if table["profile"] not in profiles:
            kept = sorted(profiles)
            raise RigError(f"{where}: no [profiles.{table['profile']}]; there are {kept}")
        more["profile"] = profiles[table["profile"]]
    try:
        if "aim" in table:
            if "orientation" in more:
                raise RigError("give orientation or aim, not both")
            aim = np.asarray(table["aim"], float)
            if aim.shape != (3,) or not np.isfinite(aim).all() or not aim.any():
                raise RigError(f"aim must be a direction of 3 numbers, got {table['aim']}")
            more["orientation"] = facing(aim, float(table.get("roll_deg", 0.0)))
        return Light(*required, **more)
    except (ValueError, TypeError) as error:
        raise RigError(f"{where}: {error}") from error


def _lights(
    data: dict[str, Any], cameras: tuple[Camera, ...], profiles: dict[str, LightProfile]
) -> list[Light]:
    """Explicit `[[lights]]`, then the `[dome]`: the nearest dome light moves beside each camera.

    The dome's lights are all alike and aim at the origin.
    """
    lights = [
        _light(table, f"[[lights]] number {i + 1}", profiles)
        for i, table in enumerate(data.get("lights", []))
    ]
    dome = data.get("dome")
    if dome is None:
        return lights
    count, intensity, radius = _take(dome, "[dome]", "lights", "intensity", "radius")
    _refuse_others(dome, _DOME_FIELDS, "[dome]")
    positions = dome_positions(int(count), float(radius), float(dome.get("lowest_deg", -90.0)))
    beside: dict[int, str] = {}
    offset = float(dome.get("beside_cameras_at", 0.0))
    if offset > 0:
        for camera in cameras:
            distance = np.linalg.norm(positions - camera.center, axis=1)
            distance[list(beside)] = np.inf
            nearest = int(distance.argmin())
            beside[nearest] = camera.name
            positions[nearest] = camera.center - offset * camera.R[1]
    shared = {f: dome[f] for f in ("profile", "size", "roll_deg") if f in dome}
    if "light_radius" in dome:  # the dome's own `radius` is how far out the lights stand
        shared["radius"] = dome["light_radius"]
    shared["intensity"] = intensity
    for i, p in enumerate(positions):
        table = {"name": f"light_{i:03d}", "position": p, "beside": beside.get(i), **shared}
        if "profile" in shared or "size" in shared:
            table["aim"] = -p
        lights.append(_light(table, "[dome]", profiles))
    return lights
