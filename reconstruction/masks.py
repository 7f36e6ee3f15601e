"""Hair and skin pixels: from the user's masks, else from reflectance, else from geometry.

Without user masks the pixels of all cameras are classified together by reflectance
(`hair_features`) if they form two separate clusters. If they do not, pixels whose triangulated
point lies off the head, and subject pixels outside the head's outline, are examples of hair.
Without a head the whole subject then counts as hair.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from reconstruction.arrays import Array, Bools
from reconstruction.capture.folder import Capture, CaptureError
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_queries import depth_map, mesh_depth
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.images.hair_features import (
    TwoClasses,
    clear_classes,
    looks,
    two_classes,
)
from reconstruction.images.silhouettes import NoSilhouette, silhouette
from reconstruction.images.visual_hull import trim_edges, visual_hull
from reconstruction.light_planes.point_cloud import PointCloud
from reconstruction.report.report import Stage

Source = Literal["user", "geometry", "geometry alone", "reflectance", "silhouette"]

STANDS_OFF = 4e-3  # metres that a point must be off the head to be hair
OUTLINE = 2e-3  # metres, and a pixel at least, about a head's outline that may be the head's
_PLACE = 3e-3  # metres: what is so near looks alike
_SAME_PLACE = 5e-3  # metres: as far apart may two cameras' depths of one place be
MOST_DISAGREEMENT = 0.15
"""Of a camera's pixels, `disagreements` above which its mask is doubted: true masks have up to 0.11
(one pixel is 2 mm, hair and skin are seen past each other), one that lacks half its hair 0.5."""


@dataclass(frozen=True, eq=False)
class HairMask:
    """One camera's pixels `(H, W) bool`: `subject` is the union of `hair` and `skin`, no overlap.

    `source` says who told hair from skin: "light and lines" by looks alone, "geometry" by looks
    with a head, which has given examples of hair where looks were no two clear classes; with
    "geometry alone" all of the head looks like one thing, or neither lights nor points say what it
    is. `decided` is the share of the subject that it decided, the rest follows its neighbours.
    """

    subject: Bools
    hair: Bools
    skin: Bools
    source: Source
    decided: float


@dataclass(frozen=True, eq=False)
class MaskedCapture:
    """A `capture`, and which pixels of its cameras are hair: `masks` by the camera's name."""

    capture: Capture
    masks: Mapping[str, HairMask]

    @property
    def cameras(self) -> list[Camera]:
        """Those that have a mask."""
        return [c for c in self.capture.rig.cameras if c.name in self.masks]

    def subject_hull(self, spacing: float) -> VoxelGrid:
        """The visual hull of hair and skin; ends where only skin runs out of the picture.

        Raises `CaptureError` where there is none.
        """
        subjects = {k: trim_edges(m.subject, m.hair) for k, m in self.masks.items()}
        try:
            some = {k: subject for k, subject in subjects.items() if subject.any()}
            return visual_hull(self.cameras, some, spacing=spacing)
        except ValueError as error:
            raise CaptureError(f"{self.capture.path}: no volume for hair: {error}") from error


def hair_masks(
    capture: Capture,
    points: PointCloud | None = None,
    head: Mesh | None = None,
) -> dict[str, HairMask]:
    """Masks of every camera that has a user's mask or a silhouette.

    `network` is asked where the user gave no mask. `points` are in the reference pose, `head` the
    digitised head in the world. A camera without any frame to take a silhouette from, and without
    a user's mask, is left out. An empty silhouette gives empty masks.
    """
    geometry, masks, views = _Geometry.of(points, head), {}, []
    for camera in capture.rig.cameras:
        user = capture.mask(camera.name)
        if user is None and not any(capture.has(s, camera.name) for s in capture.steps):
            continue
        try:
            subject = silhouette(capture, camera.name)
        except NoSilhouette:
            if user is None:
                continue
            subject = user
        if user is not None:
            masks[camera.name] = HairMask(subject | user, user, subject & ~user, "user", 1.0)
        elif not subject.any():
            masks[camera.name] = HairMask(subject, subject, subject, "silhouette", 0.0)
        else:
            views.append(_View.of(capture, camera, subject, geometry))
    masks |= _by_looks([v for v in views if v.looks is not None], geometry)
    for view in (v for v in views if v.camera.name not in masks):
        masks[view.camera.name] = view.whole() if head is None else view.by_points()
    return masks


def usable_masks(
    capture: Capture, masks: Mapping[str, HairMask], stage: Stage
) -> dict[str, HairMask]:
    """The masks of the cameras of `capture` that see the subject at all; the others are warned of.

    Raises `CaptureError` where fewer than two are left or none of them has hair.
    """
    mine = {c.name: masks[c.name] for c in capture.rig.cameras if c.name in masks}
    out = {name: mask for name, mask in mine.items() if mask.subject.any()}
    if blind := [c.name for c in capture.rig.cameras if c.name not in out]:
        stage.warn(f"{', '.join(blind)} see nothing of the subject and are left out")
    if untold := [name for name, mask in out.items() if mask.source == "silhouette"]:
        where = "" if len(untold) == len(out) else f" in {', '.join(untold)}"
        stage.warn(
            f"hair could not be told from skin{where}: all of the subject counts as hair, a face "
            "too; give hair masks (masks/CAMERA.png in the capture, `hair` in import.toml) or "
            "head.obj"
        )
    if any(mask.source == "geometry alone" for mask in out.values()):
        stage.warn(
            "nothing tells hair from skin on the head: all of it was taken for one of them: look "
            "at masks/, and give hair masks where it shows both"
        )
    if not any(mask.hair.any() for mask in out.values()):
        raise CaptureError(
            f"{capture.path}: no pixel of any camera is hair: check the lights, the cameras' poses "
            "and, where given, the hair masks"
        )
    if len(out) < 2:
        raise CaptureError(f"{capture.path}: only {', '.join(out)} sees the subject, not two")
    return out


@dataclass(frozen=True, eq=False)
class _Geometry:
    """Triangulated points and the head, as cameras see them; `off` is the points' distance to it.

    `depth (H, W)` along z is that of a camera's own points, or else of the head, 0 for neither.
    """

    points: PointCloud | None
    head: Mesh | None
    off: Array | None

    @classmethod
    def of(cls, points: PointCloud | None, head: Mesh | None) -> _Geometry:
        """With the distances, where there are both."""
        if points is None or head is None or not len(points):
            return cls(points, head, None)
        return cls(points, head, distance_to(head, points.points))

    def own(self, camera: Camera) -> Bools:
        """Which points the camera saw: none where it took no part in the triangulation."""
        assert self.points is not None
        names = self.points.cameras
        return self.points.camera == (names.index(camera.name) if camera.name in names else -1)

    def depth(self, camera: Camera) -> Array:
        """Depth along z of the camera's own points, or else of the head; 0 for neither `(H, W)`."""
        out = np.zeros((camera.height, camera.width))
        if self.points is not None:
            out = depth_map(camera, self.points.points[self.own(camera)])
        if self.head is not None:
            depth = mesh_depth(camera, self.head)
            out = np.where((out == 0) & np.isfinite(depth), depth, out)
        return out

    def votes(self, camera: Camera) -> tuple[Array, Array]:
        """Weights of the points that stand off the head and that lie on it, per pixel `(H, W)`."""
        size = camera.height, camera.width
        if self.points is None or self.off is None:
            return np.zeros(size), np.zeros(size)
        mine = self.own(camera)
        seen, x, y, _ = camera.pixels_of(self.points.points[mine])
        flat = (y * camera.width + x)[seen]
        weight, standing = self.points.weight[mine][seen], self.off[mine][seen] > STANDS_OFF

        def votes(which: Bools) -> Array:
            total: Array = np.bincount(flat[which], weight[which], size[0] * size[1]).astype(float)
            return total.reshape(size)

        return votes(standing), votes(~standing)


@dataclass(frozen=True, eq=False)
class _View:
    """A camera's `subject`, and what is known of each of its pixels `(H, W)`.

    `outside` shows the subject `OUTLINE` off the head's, `standing` and `lying` have points off and
    on the head. `looks (4, P)` are those of `hair_features` at the subject's pixels, None where too
    few lights were shot.
    """

    camera: Camera
    subject: Bools
    outside: Bools
    standing: Bools
    lying: Bools
    looks: Array | None

    @property
    def seen(self) -> Array:
        """`looks` that are there."""
        assert self.looks is not None
        return self.looks

    def image(self, values: Array) -> Array:
        """`values (P,)` of the subject's pixels as an image `(H, W)`, 0 outside."""
        out = np.zeros(self.subject.shape)
        out[self.subject] = values
        return out

    @classmethod
    def of(cls, capture: Capture, camera: Camera, subject: Bools, geometry: _Geometry) -> _View:
        """What `geometry` and the OLAT frames of `capture` say of a camera."""
        outside, covered = np.zeros((2, *subject.shape), bool)
        if geometry.head is not None:
            depth = mesh_depth(camera, geometry.head)
            covered = np.isfinite(depth)
            outside = subject & ~_beside(covered, camera, depth[covered])
        off, on = geometry.votes(camera)
        standing, lying = subject & (off > on), subject & covered & (on > off)
        seen = looks(capture, camera.name, subject)
        return cls(camera, subject, outside, standing, lying, seen)

    def mask(self, hair: Bools, source: Source, decided: float) -> HairMask:
        """The mask whose hair is `hair (H, W)`, of the subject."""
        hair = hair & self.subject
        return HairMask(self.subject, hair, self.subject & ~hair, source, decided)

    def whole(self) -> HairMask:
        """The mask in which the whole subject is hair."""
        return self.mask(self.subject, "silhouette", 0.0)

    def by_points(self) -> HairMask:
        """The mask by geometry alone: what has no point follows its neighbours."""
        hair = self.outside | self.standing
        skin = self.lying & ~hair
        source: Source = "geometry" if (self.standing | self.lying).any() else "geometry alone"
        if not (hair | skin).any():
            return self.mask(self.subject, source, 0.0)
        decided = float((hair | skin).sum() / self.subject.sum())
        return self.mask(_fill(self.subject, hair, skin), source, decided)


def _by_looks(views: list[_View], geometry: _Geometry) -> dict[str, HairMask]:
    """Masks of `views` with looks; none where these show one class and geometry knows no hair.

    The classes are learned from all cameras together. What a place looks like from all of them
    counts half as much as what one pixel does.
    """
    if not views:
        return {}
    pixels = np.concatenate([v.seen.T for v in views])
    hair = np.concatenate([(v.outside | v.standing)[v.subject] for v in views])
    if hair.any():
        classes: TwoClasses | None = two_classes(pixels, hair)
    else:
        classes = clear_classes(pixels)
    if classes is None:
        return {}
    source: Source = "reflectance" if geometry.head is None else "geometry"
    if not classes.weights.any():
        source = "geometry alone"
    scores = [v.image(classes.scores(v.seen)) + v.standing for v in views]
    places = [_positions(v.camera, v.subject, geometry) for v in views]
    common = _by_place(places, scores)
    out = {}
    for view, score, place in zip(views, scores, common, strict=True):
        near = ndimage.gaussian_filter(view.subject.astype(np.float64), 0.5)
        total = np.where(view.outside, 6.0, score + 0.5 * place) * view.subject
        smooth = ndimage.gaussian_filter(total, 0.5) / np.maximum(near, 1e-9)
        out[view.camera.name] = view.mask(smooth > 0, source, 1.0)
    return out


def _positions(camera: Camera, subject: Bools, geometry: _Geometry) -> Array:
    """Where in the world the subject's pixels are `(H, W, 3)`, NaN where that is not known."""
    depth = geometry.depth(camera)
    y, x = np.nonzero(subject & (depth > 0))
    rays = camera.rays(np.stack([x, y], axis=1))
    out = np.full((*subject.shape, 3), np.nan)
    out[y, x] = camera.center + rays * (depth[y, x] / (rays @ camera.R[2]))[:, None]
    return out


def _by_place(places: list[Array], scores: list[Array]) -> list[Array]:
    """The mean of `scores (H, W)` of all cameras about each pixel's place, 0 where it has none.

    Of the cells of `_PLACE` metres, weighted by a Gaussian as wide.
    """
    known = [np.isfinite(p[..., 0]) for p in places]
    points = np.concatenate([p[k] for p, k in zip(places, known, strict=True)])
    out = [np.zeros(s.shape) for s in scores]
    if not len(points):
        return out
    values = np.concatenate([s[k] for s, k in zip(scores, known, strict=True)])
    cell, count = np.unique(
        np.floor(points / _PLACE).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )[1:]
    cell = cell.ravel()
    middle = np.stack([np.bincount(cell, p) / count for p in points.T], axis=1)
    total = np.bincount(cell, values)
    distance, index = cKDTree(middle).query(middle, k=min(24, len(middle)))
    weight = np.exp(-0.5 * (distance / _PLACE) ** 2).reshape(len(middle), -1)
    index = index.reshape(weight.shape)
    pooled = (weight * total[index]).sum(axis=1) / (weight * count[index]).sum(axis=1)
    parts = np.split(pooled[cell], np.cumsum([int(k.sum()) for k in known])[:-1])
    for image, k, part in zip(out, known, parts, strict=True):
        image[k] = part
    return out


def report_agreement(
    capture: Capture,
    masks: Mapping[str, HairMask],
    points: PointCloud | None,
    head: Mesh | None,
    stage: Stage,
) -> None:
    """Leave `disagreements` in the report; warn of those above `MOST_DISAGREEMENT`."""
    found = disagreements(masks, capture.rig.cameras, points, head)
    stage.figures["disagreement"] = found
    if doubted := {k: v for k, v in found.items() if v > MOST_DISAGREEMENT}:
        shares = ", ".join(f"{name} {share:.0%}" for name, share in doubted.items())
        stage.warn(
            "masks disagree about what is hair; share of the pixels that other cameras contradict: "
            f"{shares}: look at masks/, give hair masks for these cameras or check their poses"
        )


def disagreements(
    masks: Mapping[str, HairMask],
    cameras: Sequence[Camera],
    points: PointCloud | None = None,
    head: Mesh | None = None,
) -> dict[str, float]:
    """By camera, the share of its pixels that the other cameras that see their place contradict.

    A place is a cell of `_SAME_PLACE` metres, where the camera's own triangulated points or else
    the head put a pixel. Three in four of the other cameras' pixels there must say hair where the
    mask says skin, or the reverse: cells at a hairline hold both. Cameras with under a hundred
    such places are left out.
    """
    geometry = _Geometry(points, head, None)
    cells, hairs, owners = [], [], []
    for number, camera in enumerate(c for c in cameras if c.name in masks):
        mask = masks[camera.name]
        place = _positions(camera, mask.subject, geometry)
        known = np.isfinite(place[..., 0])
        cells.append(np.floor(place[known] / _SAME_PLACE).astype(np.int64))
        hairs.append(mask.hair[known])
        owners.append(np.full(len(hairs[-1]), number))
    names = [c.name for c in cameras if c.name in masks]
    if not names or not sum(map(len, cells)):
        return {}
    hair, owner = np.concatenate(hairs), np.concatenate(owners)
    cell = np.unique(np.concatenate(cells), axis=0, return_inverse=True)[1].ravel()
    size = cell.max() + 1
    all_hair, all_count = np.bincount(cell, hair, size), np.bincount(cell, minlength=size)
    out = {}
    for number, name in enumerate(names):
        mine = owner == number
        own_hair = np.bincount(cell[mine], hair[mine], size)
        others = all_count - np.bincount(cell[mine], minlength=size)
        there = others[cell[mine]] > 0
        share = (all_hair - own_hair)[cell[mine]][there] / others[cell[mine]][there]
        if there.sum() >= 100:
            against = np.where(hair[mine][there], share < 0.25, share > 0.75)
            out[name] = float(against.mean())
    return out


def distance_to(head: Mesh, points: Array) -> Array:
    """Distances `(N,)` of `points (N, 3)` in front of the surface of `head`, metres.

    To the nearest of samples 2 mm apart, along their normal where the point is closer than 1 cm:
    negative inside a closed mesh whose normals point outwards.
    """
    samples, normals = _samples(head, 2e-3)
    distance, index = cKDTree(samples).query(points)
    height = np.einsum("ni,ni->n", points - samples[index], normals[index])
    return np.where(distance < 0.01, height, distance)


def _samples(head: Mesh, step: float) -> tuple[Array, Array]:
    """Points `(N, 3)` about `step` apart on every face of `head`, and their normals `(N, 3)`."""
    corners = head.vertices[head.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    divisions = np.maximum(np.ceil(longest / step).astype(int), 1)
    normals = head.face_normals()
    points, faces = [], []
    for n in np.unique(divisions):
        of = np.flatnonzero(divisions == n)
        i, j = np.nonzero(np.add.outer(np.arange(n), np.arange(n)) < n)
        u, v = (i + 1 / 3) / n, (j + 1 / 3) / n
        weights = np.stack([1 - u - v, u, v], axis=1)
        points.append(np.einsum("kc,fci->fki", weights, corners[of]).reshape(-1, 3))
        faces.append(np.repeat(of, len(weights)))
    return np.concatenate(points), normals[np.concatenate(faces)]


def _beside(covered: Bools, camera: Camera, depth: Array) -> Bools:
    """What a head is or its outline's error may be `(H, W)`, of the pixels that it has `covered`.

    `depth (P,)` of those, metres.
    """
    if not covered.any():
        return covered
    pixels = max(1.0, OUTLINE * camera.K[0, 0] / float(np.median(depth)))
    return np.asarray(ndimage.distance_transform_edt(~covered) <= pixels)


def _fill(subject: Bools, hair: Bools, skin: Bools) -> Bools:
    """Hair over all of the subject: undecided pixels follow decided ones, specks are voted out."""
    known = (hair | skin).astype(np.float64)
    score = np.zeros(subject.shape)
    for sigma in (1.0, 2.0, 4.0, 8.0):
        vote = ndimage.gaussian_filter(hair - skin.astype(np.float64), sigma)
        weight = ndimage.gaussian_filter(known, sigma)
        undecided = (score == 0) & (weight > 1e-3)
        score[undecided] = vote[undecided] / weight[undecided]
    nearest = ndimage.distance_transform_edt(known == 0, return_indices=True)[1]
    left = score == 0
    score[left] = np.where(hair[tuple(nearest)], 1.0, -1.0)[left]
    return np.asarray(subject & (score > 0))
