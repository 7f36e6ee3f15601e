"""Consistency of a capture's lights with its images, from small copies of the images.

Three errors of imported captures are detected: light positions in other axes than the cameras, a
light whose position and images belong to different lights, and cameras whose images are exchanged.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations, product

import cv2
import numpy as np

from reconstruction.arrays import Array, Bools
from reconstruction.capture.folder import Capture
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.placement import PlacementError, Sight

TILES = 12
MOST_CAMERAS = 4
MOST_COMPARED = 16  # cameras whose images may be exchanged
LEAST_LIGHTS = 24


def check_scene(capture: Capture) -> list[str]:
    """One sentence per suspected error in the lights of `capture`; empty if none.

    Reads the single-light images of up to `MOST_CAMERAS` cameras; needs `LEAST_LIGHTS` lights.
    """
    cameras = list(capture.rig.cameras)
    try:
        point = Sight.of(cameras).point
    except PlacementError:
        return []
    lights = capture.olat_lights()
    if len(lights) < LEAST_LIGHTS:
        return []
    chosen = cameras[:: max(1, len(cameras) // MOST_CAMERAS)][:MOST_CAMERAS]
    images = np.stack([_tiles(capture, c, lights) for c in chosen], axis=1)
    there: Bools = np.asarray(np.isfinite(images).all(axis=2))
    used = np.asarray(there.mean(axis=0) > 0.8)
    complete = np.flatnonzero(there[:, used].all(axis=1))
    if not used.any() or len(complete) < LEAST_LIGHTS:
        return []
    images, names = images[complete][:, used], [lights[k] for k in complete]
    where = np.array([capture.rig.light(n).position for n in names]) - point
    towards = np.array([c.center for c in chosen])[used] - point
    odd = [
        f"{names[k]}: its images resemble those of lights {angle:.0f}° away; do its position and "
        "its images belong to the same light?"
        for k, angle in odd_lights(images, where).items()
    ]
    exchanged = _exchanged(capture, cameras[:MOST_COMPARED], point)
    return [*check_light_axes(images, where, towards), *odd, *exchanged]


def _exchanged(capture: Capture, cameras: Sequence[Camera], point: Array) -> list[str]:
    """`exchanged_cameras` from `2 * LEAST_LIGHTS` lights."""
    names = capture.olat_lights()
    names = names[:: max(1, len(names) // (2 * LEAST_LIGHTS))]
    bright = np.stack([_tiles(capture, c, names).mean(axis=1) for c in cameras], axis=1)
    used = np.isfinite(bright).mean(axis=0) > 0.8
    lit = np.isfinite(bright[:, used]).all(axis=1)
    if used.sum() < 3 or lit.sum() < LEAST_LIGHTS:
        return []
    kept = [c for c, there in zip(cameras, used, strict=True) if there]
    where = np.array([capture.rig.light(n).position for n in names])[lit] - point
    found = exchanged_cameras(
        bright[lit][:, used], where, np.array([c.center for c in kept]) - point
    )
    return [
        f"{kept[i].name}, {kept[k].name}: the light in their images fits the other one's place: "
        "are their images or poses exchanged?"
        for i, k in found
    ]


def exchanged_cameras(bright: Array, where: Array, towards: Array) -> list[tuple[int, int]]:
    """Pairs of cameras whose brightness under lights fits each other's place.

    `bright (L, C)`; `where (L, 3)` and `towards (C, 3)` are positions of lights and cameras from
    the subject. Lights near a camera make its images brighter than those of the others.
    """
    places = where / np.linalg.norm(where, axis=1, keepdims=True)
    eyes = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    shown, facing = _interaction(np.log(np.maximum(bright, 1e-12))), _interaction(places @ eyes.T)
    shown, facing = (x / np.maximum(np.linalg.norm(x, axis=0), 1e-12) for x in (shown, facing))
    fit = shown.T @ facing
    gain = np.diag(fit)[:, None], np.diag(fit)[None]
    better = (fit + fit.T - gain[0] - gain[1] > 0.6) & (np.minimum(fit, fit.T) > 0.3)
    return [(int(i), int(k)) for i, k in np.argwhere(np.triu(better, 1))]


def _tiles(capture: Capture, camera: Camera, lights: Sequence[str]) -> Array:
    """Mean radiance in `TILES`² tiles under each light `(L, TILES²)`; NaN for a missing frame."""
    out = np.full((len(lights), TILES * TILES), np.nan)
    for step in capture.of_kind("olat"):
        if step.light in lights and capture.has(step, camera.name):
            grey = np.ascontiguousarray(capture.frame(step, camera.name).mean(axis=-1), np.float32)
            tiles = cv2.resize(grey, (TILES, TILES), interpolation=cv2.INTER_AREA)
            out[lights.index(str(step.light))] = tiles.ravel()
    return out


def odd_lights(pictures: Array, where: Array) -> dict[int, float]:
    """Lights whose images resemble those of distant lights: index to angle, degrees.

    `pictures (L, C, T)` of C cameras in T tiles; `where (L, 3)` from the subject. The angle is
    between a light and the median of the six lights with the most similar images. Returned are
    angles above 40° and above four times the median.
    """
    angles = _angles(pictures, where)
    limit = max(40.0, 4 * float(np.median(angles)))
    return {int(k): float(angles[k]) for k in np.flatnonzero(angles > limit)}


def _angles(pictures: Array, where: Array) -> Array:
    directions = where / np.linalg.norm(where, axis=1, keepdims=True)
    rows = pictures.reshape(len(where), -1)
    rows = rows - rows.mean(axis=0)
    rows /= np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300)
    like = rows @ rows.T
    np.fill_diagonal(like, -np.inf)
    nearest = np.argsort(-like, axis=1)[:, :6]
    mean = np.array([np.median(directions[near], axis=0) for near in nearest])
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    return np.asarray(np.degrees(np.arccos(np.clip((mean * directions).sum(axis=1), -1, 1))))


def check_light_axes(pictures: Array, where: Array, towards: Array) -> list[str]:
    """Whether lights near a camera make that camera's images brighter than the others'.

    `pictures (L, C, T)`; `where (L, 3)` and `towards (C, 3)` are positions of lights and cameras
    from the subject. Compared with all permutations and reflections of the lights' axes. Means per
    light and per camera are removed first: dark hair above bright skin is brighter under lights
    from below in every camera.
    """
    bright = _interaction(np.log(np.maximum(pictures.mean(axis=2), 1e-12)))
    places = where / np.linalg.norm(where, axis=1, keepdims=True)
    eyes = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    found = {}
    for axes in permutations(range(3)):
        for signs in product((1, -1), repeat=3):
            facing = _interaction((places[:, axes] * signs) @ eyes.T)
            named = zip(axes, signs, strict=True)
            key = " ".join(("-" if s < 0 else "") + "xyz"[a] for a, s in named)
            norm = float(np.linalg.norm(facing) * np.linalg.norm(bright))
            found[key] = float((facing * bright).sum()) / max(norm, 1e-12)
    best = max(found, key=lambda k: found[k])
    if found[best] < 0.5 or found[best] < found["x y z"] + 0.15:
        return []
    return [
        f"the lights' axes do not fit the cameras': brightness correlates with the angle between "
        f"light and camera by {found['x y z']:.2f}, with the axes {best} by {found[best]:.2f}; "
        "permute the axes of the lights' file"
    ]


def _interaction(values: Array) -> Array:
    """`values (L, C)` without the means of each light and of each camera."""
    return np.asarray(
        values - values.mean(axis=0) - values.mean(axis=1, keepdims=True) + values.mean()
    )
