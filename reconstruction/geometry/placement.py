"""Cameras and lights that others calibrated, brought into our world; is it plausible there?

Our world is in metres with z up, its cameras look along z with y down. Files of cameras say neither
their unit nor which way is up, and some take the camera's axes for OpenGL's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from reconstruction.arrays import Array, Bools
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lights import Light
from reconstruction.options import options

Unit = Literal["m", "cm", "mm", "inch"] | Annotated[float, Field(gt=0)]
Up = Literal["x", "-x", "y", "-y", "z", "-z"]
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
NEAREST, FURTHEST = 0.15, 8.0
"""Metres from the subject at which a stage's cameras and lights can stand."""
_FLIP = np.diag([1.0, -1.0, -1.0])


class PlacementError(ValueError):
    """Cameras or lights that cannot stand like this; the message says what to do."""


@options
class PlacementOptions:
    """What a user says of files of cameras and lights.

    `unit` is the length of the cameras' unit, by name or in metres, `light_unit` the lights' where
    it differs; `up` the axis of the world that points up; `camera_axes` those of the cameras, where
    they are not what the format says.
    """

    unit: Unit = "m"
    light_unit: Unit | None = None
    up: Up | None = None
    camera_axes: Literal["opencv", "opengl"] | None = None


def metres(unit: Unit) -> float:
    """The length of a unit."""
    return METRES[unit] if isinstance(unit, str) else float(unit)


def to_z_up(up: Up) -> Array:
    """The rotation `(3, 3)` that takes the axis `up` to z.

    y goes to z by a quarter turn about x, as from Blender's exporters and back.
    """
    axis, sign = "xyz".index(up[-1]), -1.0 if up.startswith("-") else 1.0
    if axis == 2:
        return np.eye(3) if sign > 0 else np.diag([1.0, -1.0, -1.0])
    if axis == 1:
        return np.array([[1, 0, 0], [0, 0, -sign], [0, sign, 0.0]])
    return np.array([[0, 0, -sign], [0, 1, 0], [sign, 0, 0.0]])


def placed(
    cameras: Sequence[Camera], options: PlacementOptions, axes: Literal["opencv", "opengl"]
) -> list[Camera]:
    """The cameras in metres, z up, with our axes; their file was read as if it had `axes`."""
    turn = to_z_up(options.up or "z")
    flip = _FLIP if options.camera_axes not in (None, axes) else np.eye(3)
    out = []
    for camera in cameras:
        center = metres(options.unit) * turn @ camera.center
        R = flip @ camera.R @ turn.T
        out.append(replace(camera, R=R, t=-R @ center))
    return out


def placed_lights(lights: Sequence[Light], options: PlacementOptions) -> list[Light]:
    """The lights in metres, z up."""
    turn, unit = to_z_up(options.up or "z"), options.light_unit or options.unit
    return [
        replace(
            light,
            position=metres(unit) * turn @ light.position,
            orientation=None if light.orientation is None else light.orientation @ turn.T,
        )
        for light in lights
    ]


def resized(camera: Camera, width: int, height: int) -> Camera:
    """`camera` with the intrinsics of its picture scaled to `width` x `height`.

    Raises `PlacementError` where that picture has another shape: it was cropped or turned.
    """
    if (width, height) == (camera.width, camera.height):
        return camera
    sx, sy = width / camera.width, height / camera.height
    if abs(sx * camera.height - height) > 1 and abs(sy * camera.width - width) > 1:
        turned = abs(camera.height * height - camera.width * width) <= max(width, height)
        raise PlacementError(
            f"{camera.name}: its calibration is for {camera.width}x{camera.height} pixels, the "
            f"picture has {width}x{height}: "
            + (
                "turn the pictures by 90° (and beware of EXIF's orientation)"
                if turned and width != height
                else "no scaled copy; calibrate for the cropped pictures, or give whole ones"
            )
        )
    K = camera.K.copy()
    K[0] *= sx
    K[1] *= sy
    K[:2, 2] += (sx - 1) / 2, (sy - 1) / 2
    return replace(camera, K=K, width=width, height=height)


@dataclass(frozen=True)
class Sight:
    """What cameras look at together.

    `point (3,)` is nearest to all lines through the pictures' centres, `distance (N,)` how far it
    is from each camera, `seen (N,)` whether it is in front of that and on its picture, or at most
    half a picture beside it. `diversity` is 0 where all look the same way, 1 from all around.
    `astray` is the median angle by which cameras look past the point, over that between a camera's
    way to look and their mean: small where they turn to one point, about 1 where by chance.
    """

    point: Array
    distance: Array
    seen: Bools
    diversity: float
    astray: float

    @property
    def whole(self) -> bool:
        """Whether nine in ten cameras see it."""
        return bool(self.seen.mean() >= 0.9)

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> Sight:
        """Raises `PlacementError` where all cameras look the same way, or there is but one."""
        centers = np.array([c.center for c in cameras])
        axes = np.array([c.rays([(c.width - 1) / 2, (c.height - 1) / 2]) for c in cameras])
        weight, point = np.ones(len(cameras)), np.zeros(3)
        for _ in range(20):  # few cameras that look elsewhere shall not draw the point to them
            across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
            A = (weight[:, None, None] * across).sum(axis=0)
            if np.linalg.cond(A) > 1e8:
                raise PlacementError("the cameras all look the same way: nothing is in their midst")
            point = np.linalg.solve(A, np.einsum("n,nij,nj->i", weight, across, centers))
            miss = np.linalg.norm(np.einsum("nij,nj->ni", across, point - centers), axis=1)
            weight = 1 / np.maximum(miss, 1e-3 * np.median(miss) + 1e-12)
        seen = []
        for camera in cameras:
            pixel, depth = camera.pinhole().project(point)
            beside = np.abs(pixel / (camera.width, camera.height) - 0.5)
            seen.append(bool(depth > 0 and (beside < 1).all()))
        distance = np.linalg.norm(centers - point, axis=1)
        along = np.einsum("ni,ni->n", axes, point - centers)
        past = np.median(np.abs(np.arctan2(np.sqrt(np.maximum(distance**2 - along**2, 0)), along)))
        diversity = 1 - float(np.linalg.norm(axes.mean(axis=0)))
        astray = float(past) / max(float(np.arccos(1 - diversity)), 1e-12)
        return cls(point, distance, np.array(seen), diversity, astray)


def check_cameras(cameras: Sequence[Camera], options: PlacementOptions, axes: str) -> list[str]:
    """Whether cameras that were `placed` can be a stage's; what there is to be said of them.

    Raises `PlacementError` that names the option to give where axes, unit or the world's up are
    not what they were taken for, and the cameras where single ones look elsewhere.
    """
    if len(cameras) < 2:
        return ["one camera alone: nothing says whether unit and axes are right"]
    sight = Sight.of(cameras)
    for told, reading in _misreadings(cameras, options.camera_axes or axes).items():
        other = _sight(reading)
        if other is None or not other.whole:
            continue
        closer = sight.diversity < 0.5 * other.diversity and other.astray < sight.astray
        if closer or not sight.whole:
            raise PlacementError(f"the cameras do not look at anything together, but do {told}")
    if not sight.whole:
        raise PlacementError(_elsewhere(cameras, sight))
    notes = []
    if not sight.seen.all():
        names = [c.name for c, seen in zip(cameras, sight.seen, strict=True) if not seen]
        notes.append(f"{', '.join(names)}: do not look at what the other cameras look at")
    distance = float(np.median(sight.distance))
    if not NEAREST <= distance <= FURTHEST:
        scaled = {n: distance * m / metres(options.unit) for n, m in METRES.items()}
        text = f"the cameras stand {length(distance)} from what they look at"
        raise PlacementError(text + _right_unit(scaled, "--unit"))
    try:
        unsure = _check_up(cameras)
        notes += unsure if options.up is None else []
    except PlacementError:
        if options.up is None:
            raise
        notes.append(
            f"--up {options.up} is believed, though the cameras then lie on their side or stand on "
            "their heads"
        )
    width = float(
        np.median([d * c.width / c.K[0, 0] for c, d in zip(cameras, sight.distance, strict=True)])
    )
    notes.append(
        f"cameras stand {distance:.2f} m from what they look at, where their pictures are "
        f"{width:.2f} m wide"
    )
    return notes


def check_lights(cameras: Sequence[Camera], lights: Sequence[Light], unit: Unit) -> None:
    """Raises `PlacementError` where lights stand too far from what the cameras look at."""
    if len(cameras) < 2 or not lights:
        return
    point = Sight.of(cameras).point
    positions = np.array([light.position for light in lights])

    def distance(scale: float) -> float:
        return float(np.median(np.linalg.norm(scale * positions - point, axis=1)))

    if not NEAREST <= distance(1.0) <= FURTHEST:
        scaled = {n: distance(m / metres(unit)) for n, m in METRES.items()}
        text = f"the lights stand {length(distance(1.0))} from what the cameras look at"
        raise PlacementError(text + _right_unit(scaled, "--light-unit"))


def _right_unit(distances: dict[str, float], option: str) -> str:
    """What to give where the distances in metres are those if the file counts in each unit."""
    fits = [n for n, d in distances.items() if 2 * NEAREST <= d <= FURTHEST / 2]
    fits = [n for n in fits if n != "inch"] or fits
    if not fits:
        return f": give the length of their unit in metres, as {option} 0.37"
    names = {"m": "metres", "cm": "centimetres", "mm": "millimetres", "inch": "inches"}
    return "; their file counts in " + " or ".join(f"{names[n]}: give {option} {n}" for n in fits)


def length(value: float) -> str:
    """`value` metres, for people."""
    if value >= 1000:
        return f"{value / 1000:.3g} km"
    return f"{value:.3g} m" if value >= 0.1 else f"{1000 * value:.3g} mm"


def _elsewhere(cameras: Sequence[Camera], sight: Sight) -> str:
    names = [c.name for c, seen in zip(cameras, sight.seen, strict=True) if not seen]
    return (
        f"{len(names)} of {len(cameras)} cameras do not look at what the others look at: "
        f"{', '.join(names[:8])}{', …' if len(names) > 8 else ''}; are the poses of one solution, "
        "and do they take the world to the camera?"
    )


def _misreadings(cameras: Sequence[Camera], read: str) -> dict[str, list[Camera]]:
    """How the cameras would stand had their file been read in another way, by what to do then.

    Read the other way round, cameras that look at one point end up in one place and look the same
    way: the reading in which they look from the most sides is the right one, if they look at one
    point there at all. Where the origin is elsewhere, a wrong reading may show all kinds of ways.
    """
    other = "opencv" if read == "opengl" else "opengl"
    inverse = "the file gives camera-to-world where world-to-camera is asked for (or the reverse)"
    return {
        f"with {_AXES[other]}, where {_AXES[read]} were read: give --camera-axes {other}": [
            replace(c, R=_FLIP @ c.R, t=_FLIP @ c.t) for c in cameras
        ],
        f"with their poses the other way round: {inverse}; invert them": [
            replace(c, R=c.R.T, t=c.center) for c in cameras
        ],
        f"with their poses the other way round and {_AXES[other]}: {inverse}; invert them, and "
        f"give --camera-axes {other}": [
            replace(c, R=_FLIP @ c.R.T, t=_FLIP @ c.center) for c in cameras
        ],
    }


_AXES = {
    "opencv": "OpenCV's axes (y down, z forward)",
    "opengl": "OpenGL's axes (y up, z backwards)",
}


def _sight(cameras: Sequence[Camera]) -> Sight | None:
    try:
        return Sight.of(cameras)
    except PlacementError:
        return None


def _check_up(cameras: Sequence[Camera]) -> list[str]:
    """Raises where pictures stand upright, or on their side, to another axis than z.

    One axis of a picture that is upright or turned by 90° runs along up, unless the camera looks
    up or down steeply.
    """
    right, down = (np.array([c.R[i] for c in cameras]) for i in (0, 1))
    upright = np.quantile(np.abs(down), 0.1, axis=0)  # along x, y, z; one in ten may be steep
    along = np.quantile(np.maximum(np.abs(right), np.abs(down)), 0.1, axis=0)
    for measure in (upright, along):
        axis = int(measure.argmax())
        if measure[axis] < 0.6:
            continue
        sign = "-" if np.median(down[:, axis]) > 0.3 else ""
        up = f"{sign}{'xyz'[axis]}"
        if up == "z" or (measure[2] >= 0.6 and axis != 2):
            return []
        raise PlacementError(
            f"the cameras stand upright to the axis {up} of their world, not to z, which is up "
            f"here: give --up {up} (or --up z where it is up indeed)"
        )
    return ["the cameras' tilts do not say which way is up: z was taken (else give --up)"]
