"""Do pictures, cameras and lights belong together? Swapped cameras, lights that stand elsewhere.

Told from the pictures alone, small copies of them: silhouettes that leave no volume in common
(Hernández, Schmitt and Cipolla, "Silhouette coherence for camera calibration", TPAMI 2007), and
lights under which the subject looks like under lights from elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, permutations, product

import cv2
import numpy as np

from reconstruction.arrays import Array, Bools, Floats, Ints
from reconstruction.capture.folder import Capture
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.placement import PlacementError, Sight

EDGE = 48
"""Voxels along the edge of the cube about what the cameras look at."""
SMALL = 96
"""Pixels along the longer side of the pictures that silhouettes are taken from."""
TILES = 12
MOST_CAMERAS = 4
MOST_LIGHTS = 16
COHERENT, SOUND, POOR = 0.97, 0.95, 0.9
"""How much of each silhouette what all cameras see fills: where all fits, may, and does not."""
GAIN = 1.01
"""How much larger what all cameras see must become by an exchange for it to be said."""
LEAST_LIGHTS = 24


def check_scene(capture: Capture) -> list[str]:
    """Sentences on what seems wrong with the cameras and lights of `capture`; none where all fits.

    Reads up to `MOST_LIGHTS` pictures of each camera, and all of `MOST_CAMERAS`.
    """
    cameras = list(capture.rig.cameras)
    try:
        point = Sight.of(cameras).point
    except PlacementError:
        return []
    masks = {c.name: m for c in cameras if (m := _silhouette(capture, c)) is not None}
    out = check_silhouettes([c for c in cameras if c.name in masks], masks)
    lights = capture.olat_lights()
    if len(lights) >= LEAST_LIGHTS:
        chosen = cameras[:: max(1, len(cameras) // MOST_CAMERAS)][:MOST_CAMERAS]
        pictures = np.stack([_tiles(capture, c, lights) for c in chosen], axis=1)
        there: Bools = np.asarray(np.isfinite(pictures).all(axis=2))
        seeing = np.asarray(there.mean(axis=0) > 0.8)
        shown = np.flatnonzero(there[:, seeing].all(axis=1))
        if not seeing.any() or len(shown) < LEAST_LIGHTS:
            return out
        pictures, names = pictures[shown][:, seeing], [lights[k] for k in shown]
        where = np.array([capture.rig.light(n).position for n in names]) - point
        towards = np.array([c.center for c in chosen])[seeing] - point
        out += check_light_axes(pictures, where, towards)
        out += [
            f"{names[k]}: under it the subject looks as under lights {angle:.0f}° from its place; "
            "are its position and its pictures of one light?"
            for k, angle in odd_lights(pictures, where).items()
        ]
    return out


def _small(image: Floats, longest: int) -> Floats:
    """Mean over the channels, shrunk `(h, w)`."""
    grey = np.ascontiguousarray(image.mean(axis=-1), np.float32)
    scale = longest / max(grey.shape)
    size = [max(1, round(scale * n)) for n in grey.shape[::-1]]
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA)) if scale < 1 else grey


def _silhouette(capture: Capture, camera: Camera) -> Bools | None:
    """Where the subject is lit, small `(h, w)`; None where that is nothing or nearly all."""
    steps = [s for s in capture.of_kind("all_on") if capture.has(s, camera.name)][:1]
    if not steps:
        olat = [s for s in capture.of_kind("olat") if capture.has(s, camera.name)]
        steps = olat[:: max(1, len(olat) // MOST_LIGHTS)]
    if not steps:
        return None
    image = np.mean([_small(capture.frame(s, camera.name), SMALL) for s in steps], axis=0)
    mask = image > 0.06 * np.percentile(image, 98)
    return mask if 0.01 < mask.mean() < 0.9 else None


def _tiles(capture: Capture, camera: Camera, lights: Sequence[str]) -> Array:
    """Mean light in `TILES`² tiles under each light `(L, TILES²)`; NaN where a frame is missing."""
    out = np.full((len(lights), TILES * TILES), np.nan)
    for step in capture.of_kind("olat"):
        if step.light in lights and capture.has(step, camera.name):
            grey = np.ascontiguousarray(capture.frame(step, camera.name).mean(axis=-1), np.float32)
            tiles = cv2.resize(grey, (TILES, TILES), interpolation=cv2.INTER_AREA)
            out[lights.index(str(step.light))] = tiles.ravel()
    return out


@dataclass(frozen=True)
class _Voxels:
    """`inside[p, m]` `(V,)`: voxels that camera p's pose puts on camera m's silhouette."""

    centers: Array
    cameras: Sequence[Camera]
    masks: Sequence[Bools]

    @cached_property
    def _shares(self) -> list[Array]:
        """Where voxels are in each pose's picture `(V, 2)`, as shares of it; NaN behind it."""
        return [_shares(camera, self.centers) for camera in self.cameras]

    def inside(self, pose: int, mask: int) -> Bools:
        x, y, seen = _pixels(self._shares[pose], self.masks[mask])
        out = np.ones(len(self.centers), bool)  # off the picture nothing is known
        out[seen] = self.masks[mask][y[seen], x[seen]]
        return out

    def covered(self, hull: Bools, pose: int, mask: int) -> float:
        """The share of a silhouette that the hull's picture covers."""
        silhouette = self.masks[mask]
        x, y, seen = _pixels(self._shares[pose][hull], silhouette)
        picture = np.zeros(silhouette.shape, np.uint8)
        picture[y[seen], x[seen]] = 1
        picture = cv2.morphologyEx(picture, cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8))
        return float((picture.astype(bool) & silhouette).sum() / silhouette.sum())


def _shares(camera: Camera, points: Array) -> Array:
    pixels, depth = camera.pinhole().project(points)
    share = (pixels + 0.5) / (camera.width, camera.height)
    return np.where(depth[:, None] > 0, share, np.nan)


def _pixels(shares: Array, mask: Bools) -> tuple[Ints, Ints, Bools]:
    """Columns, rows and whether they are on it, of a small picture."""
    size = mask.shape[::-1]
    seen: Bools = np.asarray(((shares >= 0) & (shares < 1)).all(axis=1))
    x, y = (np.where(seen[:, None], shares, 0) * size).astype(int).T
    return x, y, seen


def check_silhouettes(cameras: Sequence[Camera], masks: Mapping[str, Bools]) -> list[str]:
    """Whether `masks[name] (h, w)`, of any size, are silhouettes of one thing seen by `cameras`.

    What is round about an axis looks the same from all around: there swapped cameras do not show.
    """
    if len(cameras) < 4:
        return []
    sight = Sight.of(cameras)
    wide = [d * c.width / c.K[0, 0] for c, d in zip(cameras, sight.distance, strict=True)]
    axis = np.median(wide) * ((np.arange(EDGE) + 0.5) / EDGE - 0.5)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    voxels = _Voxels(sight.point + grid, cameras, [masks[c.name] for c in cameras])
    n = range(len(cameras))
    own = np.array([voxels.inside(i, i) for i in n])
    near = (~own).sum(axis=0) <= 2  # two exchanged cameras can bring no other voxel back
    voxels, own = replace(voxels, centers=voxels.centers[near]), own[:, near]
    out = (~own).sum(axis=0)

    def agreement(hull: Bools, poses: Sequence[int], left: int | None = None) -> float:
        return min(voxels.covered(hull, poses[i], i) for i in n if i != left)

    names, volume = [c.name for c in cameras], int((out == 0).sum())
    before = agreement(out == 0, list(n))
    if before >= COHERENT:
        return []
    gains = {}
    for i, j in combinations(n, 2):
        less = out - ~own[i] - ~own[j]
        if (less == 0).sum() > GAIN * volume:
            gains[i, j] = int((less + ~voxels.inside(i, j) + ~voxels.inside(j, i) == 0).sum())
    if gains and max(gains.values()) > GAIN * volume:
        i, j = max(gains, key=lambda pair: gains[pair])
        poses = list(n)
        poses[i], poses[j] = j, i
        hull = out - ~own[i] - ~own[j] + ~voxels.inside(i, j) + ~voxels.inside(j, i) == 0
        after = agreement(hull, poses)
        if after > max(before, SOUND):
            return [
                f"{names[i]} and {names[j]}: their pictures, or their poses, seem to be exchanged: "
                f"the worst silhouette is filled to {before:.1%}, with these exchanged {after:.1%}"
            ]
    worst = {i: agreement(out - ~own[i] == 0, list(n), i) for i in n}
    i = max(worst, key=lambda k: worst[k])
    if worst[i] >= COHERENT and before < POOR:
        return [
            f"{names[i]}: its silhouette does not fit the others'. What all see fills the worst "
            f"silhouette to {before:.0%}, without it to {worst[i]:.0%}: its pose, or its pictures, "
            "may be another's"
        ]
    if before >= POOR:
        return []
    return [
        f"the cameras' silhouettes do not fit together: what all see fills the worst of them to "
        f"{before:.0%}: poses, or the size of pictures, may be wrong (a bright background does it "
        "too)"
    ]


def odd_lights(pictures: Array, where: Array) -> dict[int, float]:
    """Lights whose pictures are like those of lights from elsewhere: number to angle, degrees.

    `pictures (L, C, T)` of C cameras in T tiles; `where (L, 3)` from the subject.
    A light is held against the six whose pictures are most like its own. Said is which stand out:
    over 40°, and over four times the median of all.
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
    """Whether a light makes those pictures bright whose cameras it stands nearest to.

    `pictures (L, C, T)`, `where (L, 3)` and `towards (C, 3)`, places of lights and cameras, from
    the subject. Held against all exchanges and turnings round of the axes of the lights' world.
    What all cameras see alike of a light says nothing: dark hair above bright skin is brighter
    under lights from below.
    """
    bright = _apart(np.log(np.maximum(pictures.mean(axis=2), 1e-12)))
    places = where / np.linalg.norm(where, axis=1, keepdims=True)
    eyes = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    found = {}
    for axes in permutations(range(3)):
        for signs in product((1, -1), repeat=3):
            turned = places[:, axes] * signs
            facing = _apart(turned @ eyes.T)
            named = zip(axes, signs, strict=True)
            key = " ".join(("-" if s < 0 else "") + "xyz"[a] for a, s in named)
            both = float(np.linalg.norm(facing) * np.linalg.norm(bright))
            found[key] = float((facing * bright).sum()) / max(both, 1e-12)
    best = max(found, key=lambda k: found[k])
    if found[best] < 0.5 or found[best] < found["x y z"] + 0.15:
        return []
    return [
        f"pictures are brighter than other cameras' under lights that do not stand before theirs "
        f"(correlation {found['x y z']:.2f}); were the lights' axes {best}, it would be "
        f"{found[best]:.2f}: turn the file of lights so"
    ]


def _apart(values: Array) -> Array:
    """What of `values (L, C)` is neither a light's in all cameras nor a camera's under all."""
    return np.asarray(
        values - values.mean(axis=0) - values.mean(axis=1, keepdims=True) + values.mean()
    )
