"""Imported cameras and lights in our world (metres, z up, OpenCV axes), and plausibility checks.

Camera files give neither unit nor up axis, and some use OpenGL's camera axes.
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
PARALLEL = "the cameras' optical axes are parallel: no common target"
_FLIP = np.diag([1.0, -1.0, -1.0])


class PlacementError(ValueError):
    """Implausible placement of cameras or lights; the message names the option to give."""


@options
class PlacementOptions:
    """Unit and axes of imported cameras and lights.

    `unit` is the length of the cameras' unit, by name or in metres, `light_unit` the lights' if it
    differs; `up` the axis of the world that points up; `camera_axes` overrides the format's.
    """

    unit: Unit = "m"
    light_unit: Unit | None = None
    up: Up | None = None
    camera_axes: Literal["opencv", "opengl"] | None = None


def metres(unit: Unit) -> float:
    """The length of a unit."""
    return METRES[unit] if isinstance(unit, str) else float(unit)


def to_z_up(up: Up) -> Array:
    """The rotation `(3, 3)` that takes the axis `up` to z; y by a quarter turn about x."""
    axis, sign = "xyz".index(up[-1]), -1.0 if up.startswith("-") else 1.0
    if axis == 2:
        return np.eye(3) if sign > 0 else np.diag([1.0, -1.0, -1.0])
    if axis == 1:
        return np.array([[1, 0, 0], [0, 0, -sign], [0, sign, 0.0]])
    return np.array([[0, 0, -sign], [0, 1, 0], [sign, 0, 0.0]])


def placed(
    cameras: Sequence[Camera], options: PlacementOptions, axes: Literal["opencv", "opengl"]
) -> list[Camera]:
    """The cameras in metres, z up, with OpenCV axes; their file was read with `axes`."""
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
    """`camera` with intrinsics scaled to `width` x `height`.

    Raises `PlacementError` for another aspect ratio: the image was cropped or rotated.
    """
    if (width, height) == (camera.width, camera.height):
        return camera
    sx, sy = width / camera.width, height / camera.height
    if abs(sx * camera.height - height) > 1 and abs(sy * camera.width - width) > 1:
        turned = abs(camera.height * height - camera.width * width) <= max(width, height)
        raise PlacementError(
            f"{camera.name}: its calibration is for {camera.width}x{camera.height} pixels, the "
            f"image has {width}x{height}: "
            + (
                "rotate the images by 90° (check the EXIF orientation)"
                if turned and width != height
                else "it was cropped; calibrate for the cropped images, or give uncropped ones"
            )
        )
    K = camera.K.copy()
    K[0] *= sx
    K[1] *= sy
    K[:2, 2] += (sx - 1) / 2, (sy - 1) / 2
    return replace(camera, K=K, width=width, height=height)


@dataclass(frozen=True)
class Sight:
    """The common target of cameras.

    `point (3,)` is nearest to all optical axes, `distance (N,)` how far it is from each camera,
    `visible (N,)` whether it is in front of a camera and at most half an image outside of it.
    `diversity` is 0 for parallel axes, 1 for cameras all around. `miss` is the median angle
    between axis and point over that between axis and mean axis: about 1 for random directions.
    """

    point: Array
    distance: Array
    visible: Bools
    diversity: float
    miss: float

    @property
    def whole(self) -> bool:
        """Whether nine in ten cameras see it."""
        return bool(self.visible.mean() >= 0.9)

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> Sight:
        """Raises `PlacementError` for parallel axes or a single camera."""
        centers = np.array([c.center for c in cameras])
        axes = np.array([c.rays([(c.width - 1) / 2, (c.height - 1) / 2]) for c in cameras])
        weight, point = np.ones(len(cameras)), np.zeros(3)
        for _ in range(20):  # reweighted: robust to single cameras that look elsewhere
            across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
            A = (weight[:, None, None] * across).sum(axis=0)
            if np.linalg.cond(A) > 1e8:
                raise PlacementError(PARALLEL)
            point = np.linalg.solve(A, np.einsum("n,nij,nj->i", weight, across, centers))
            miss = np.linalg.norm(np.einsum("nij,nj->ni", across, point - centers), axis=1)
            weight = 1 / np.maximum(miss, 1e-3 * np.median(miss) + 1e-12)
        visible = []
        for camera in cameras:
            pixel, depth = camera.pinhole().project(point)
            beside = np.abs(pixel / (camera.width, camera.height) - 0.5)
            visible.append(bool(depth > 0 and (beside < 1).all()))
        distance = np.linalg.norm(centers - point, axis=1)
        along = np.einsum("ni,ni->n", axes, point - centers)
        past = np.median(np.abs(np.arctan2(np.sqrt(np.maximum(distance**2 - along**2, 0)), along)))
        diversity = 1 - float(np.linalg.norm(axes.mean(axis=0)))
        relative = float(past) / max(float(np.arccos(1 - diversity)), 1e-12)
        return cls(point, distance, np.array(visible), diversity, relative)


def check_cameras(cameras: Sequence[Camera], options: PlacementOptions, axes: str) -> list[str]:
    """Check that `placed` cameras can be a stage's; returns notes for the user.

    Raises `PlacementError` naming the option to give if axes, unit or up axis are implausible, or
    the cameras that do not look at the common target.
    """
    if len(cameras) < 2:
        return ["one camera: unit and axes cannot be checked"]
    sight = Sight.of(cameras)
    for hint, reading in _misreadings(cameras, options.camera_axes or axes).items():
        other = _sight(reading)
        if other is None or not other.whole:
            continue
        closer = sight.diversity < 0.5 * other.diversity and other.miss < sight.miss
        if closer or not sight.whole:
            raise PlacementError(f"the cameras have no common target, but would have one {hint}")
    if not sight.whole:
        raise PlacementError(_elsewhere(cameras, sight))
    notes = []
    if not sight.visible.all():
        names = [c.name for c, here in zip(cameras, sight.visible, strict=True) if not here]
        notes.append(f"{', '.join(names)}: the common target of the cameras is out of view")
    distance = float(np.median(sight.distance))
    if not NEAREST <= distance <= FURTHEST:
        scaled = {n: distance * m / metres(options.unit) for n, m in METRES.items()}
        text = f"the cameras stand {length(distance)} from their common target"
        raise PlacementError(text + _right_unit(scaled, "--unit"))
    try:
        unsure = _check_up(cameras)
        notes += unsure if options.up is None else []
    except PlacementError:
        if options.up is None:
            raise
        notes.append(
            f"--up {options.up} was applied, but the cameras are then on their side or upside down"
        )
    width = float(
        np.median([d * c.width / c.K[0, 0] for c, d in zip(cameras, sight.distance, strict=True)])
    )
    notes.append(
        f"cameras stand {distance:.2f} m from their common target, where their images are "
        f"{width:.2f} m wide"
    )
    return notes


def check_lights(cameras: Sequence[Camera], lights: Sequence[Light], unit: Unit) -> None:
    """Raises `PlacementError` for lights too near to or far from the cameras' common target."""
    if len(cameras) < 2 or not lights:
        return
    point = Sight.of(cameras).point
    positions = np.array([light.position for light in lights])

    def distance(scale: float) -> float:
        return float(np.median(np.linalg.norm(scale * positions - point, axis=1)))

    if not NEAREST <= distance(1.0) <= FURTHEST:
        scaled = {n: distance(m / metres(unit)) for n, m in METRES.items()}
        text = f"the lights stand {length(distance(1.0))} from the cameras' common target"
        raise PlacementError(text + _right_unit(scaled, "--light-unit"))


def _right_unit(distances: dict[str, float], option: str) -> str:
    """The option to give, from the distances in metres that each unit would result in."""
    fits = [n for n, d in distances.items() if 2 * NEAREST <= d <= FURTHEST / 2]
    fits = [n for n in fits if n != "inch"] or fits
    if not fits:
        return f": give the length of their unit in metres, as {option} 0.37"
    names = {"m": "metres", "cm": "centimetres", "mm": "millimetres", "inch": "inches"}
    return "; their file is in " + " or ".join(f"{names[n]}: give {option} {n}" for n in fits)


def length(value: float) -> str:
    """`value` metres as text with a unit."""
    if value >= 1000:
        return f"{value / 1000:.3g} km"
    return f"{value:.3g} m" if value >= 0.1 else f"{1000 * value:.3g} mm"


def _elsewhere(cameras: Sequence[Camera], sight: Sight) -> str:
    names = [c.name for c, here in zip(cameras, sight.visible, strict=True) if not here]
    return (
        f"{len(names)} of {len(cameras)} cameras do not look at the common target: "
        f"{', '.join(names[:8])}{', …' if len(names) > 8 else ''}; check that all poses are of one "
        "solution and are world-to-camera"
    )


def _misreadings(cameras: Sequence[Camera], read: str) -> dict[str, list[Camera]]:
    """The cameras under other interpretations of their file, by the hint for the user.

    Under inverted poses, cameras around a subject end up in one place with parallel axes: the
    interpretation of the greatest diversity that has a common target is right.
    """
    other = "opencv" if read == "opengl" else "opengl"
    inverse = "the file has camera-to-world where world-to-camera is expected (or the reverse)"
    return {
        f"with {_AXES[other]} instead of {_AXES[read]}: give --camera-axes {other}": [
            replace(c, R=_FLIP @ c.R, t=_FLIP @ c.t) for c in cameras
        ],
        f"with inverted poses: {inverse}; invert them": [
            replace(c, R=c.R.T, t=c.center) for c in cameras
        ],
        f"with inverted poses and {_AXES[other]}: {inverse}; invert them, and give "
        f"--camera-axes {other}": [
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
    """Raises where the images are upright, or rotated by 90°, about another axis than z."""
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
            f"the cameras are upright along the axis {up} of their world, not along z: give "
            f"--up {up} (or --up z if z is up)"
        )
    return ["the up axis is undetermined by the cameras' tilts: z was assumed (else give --up)"]
