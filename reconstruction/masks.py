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
from reconstruction.capture.folder import Capture
from reconstruction.capture.records import CaptureError
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_queries import mesh_depth, mesh_silhouette
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.images.hair_features import (
    FAINTEST_GLOSS,
    TwoClasses,
    clear_classes,
    looks,
    two_classes,
)
from reconstruction.images.silhouettes import (
    NoSilhouette,
    edges,
    silhouette,
)
from reconstruction.images.visual_hull import trim_edges, visual_hull
from reconstruction.light_planes.point_cloud import PointCloud
from reconstruction.mask_geometry import MaskGeometry, positions
from reconstruction.report.report import Stage

Source = Literal["user", "geometry", "geometry alone", "reflectance", "silhouette"]

OUTLINE = 2e-3  # metres, at least one pixel: uncertainty of a head's outline
MATTE_LIGHTS = 24
"""Least number of single lights by which cloth is separated from hair: with 16, a tenth of rendered
hair is matte over `_NEAR` pixels, with 24 a fiftieth."""
_NEAR = 9  # pixels of a square whose majority decides whether a pixel off the head is glossy
_FEWEST_GLOSSY = 0.1  # of the pixels off the head; with fewer the head is misplaced
_PLACE = 3e-3  # metres: cells in which the scores of all cameras are averaged
_SAME_PLACE = 5e-3  # metres: difference allowed between two cameras' depths of one surface point
MOST_DISAGREEMENT = 0.15
"""Share of `disagreements` above which a mask causes a warning: true masks have up to 0.11 (a pixel
is 2 mm wide), a mask that lacks half of its hair 0.5."""


@dataclass(frozen=True, eq=False)
class HairMask:
    """One camera's pixels `(H, W) bool`: `subject` is the union of `hair` and `skin`, no overlap.

    `source` is the evidence: "reflectance" alone; "geometry", reflectance with examples of hair
    from the head and the points where needed; "geometry alone" if reflectance forms one cluster or
    was not measured; "silhouette" if the whole subject counts as hair. `decided` is the share of
    the subject's pixels with evidence; the rest follows its neighbours.
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
        """Cameras with a mask."""
        return [c for c in self.capture.rig.cameras if c.name in self.masks]

    def subject_hull(self, spacing: float) -> VoxelGrid:
        """The visual hull of hair and skin; cut where only skin reaches the image border.

        Raises `CaptureError` if the masks have no volume in common.
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

    `points` are in the reference pose, `head` is the digitised head in the world. A camera with
    neither a frame nor a user's mask is omitted. An empty silhouette gives empty masks. Under
    constant light a lit background is part of the silhouette: the subject is then the user's hair
    mask and the head. Raises `CaptureError` if one of them is missing.
    """
    geometry, masks, views = MaskGeometry.of(points, head), {}, []
    constant = bool(capture.without_single_lights())
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
        if constant and _reaches_edges(subject) and capture.subject(camera.name) is None:
            if user is None or head is None:
                raise CaptureError(
                    f"{capture.path}: {camera.name}: under constant light a lit background cannot "
                    "be separated from the subject: provide masks of the subject "
                    "(subjects/CAMERA.png) and its hair (masks/CAMERA.png), or head.obj and hair "
                    "masks"
                )
            subject = mesh_silhouette(camera, head)
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
    """The masks of the cameras of `capture` whose mask shows the subject; warns of the others.

    Raises `CaptureError` if fewer than two cameras remain or no mask has hair.
    """
    mine = {c.name: masks[c.name] for c in capture.rig.cameras if c.name in masks}
    out = {name: mask for name, mask in mine.items() if mask.subject.any()}
    if blind := [c.name for c in capture.rig.cameras if c.name not in out]:
        stage.warn(f"{', '.join(blind)}: the subject is not visible; these cameras are not used")
    if silhouettes := [name for name, mask in out.items() if mask.source == "silhouette"]:
        where = "" if len(silhouettes) == len(out) else f" in {', '.join(silhouettes)}"
        stage.warn(
            f"hair and skin could not be separated{where}: the whole subject counts as hair, "
            "including the face; provide hair masks (masks/CAMERA.png in the capture, `hair` in "
            "import.toml) or head.obj"
        )
    if any(mask.source == "geometry alone" for mask in out.values()):
        stage.warn(
            "hair and skin could not be separated on the head: all of it was assigned to one of "
            "them; inspect masks/ and provide hair masks if both are visible"
        )
    if not any(mask.hair.any() for mask in out.values()):
        raise CaptureError(
            f"{capture.path}: no pixel of any camera is hair: check the lights, the camera "
            "poses and the hair masks, if provided"
        )
    if len(out) < 2:
        raise CaptureError(
            f"{capture.path}: only {', '.join(out)} shows the subject, expected 2 cameras"
        )
    return out


@dataclass(frozen=True, eq=False)
class _View:
    """A camera's `subject (H, W)` and the evidence at its pixels.

    `outside` pixels lie over `OUTLINE` outside the head's outline; `standing` and `lying` pixels
    have points off and on the head. `looks (4, P)` are the features of `hair_features` at the P
    pixels of the subject under `lights` lights, None with too few.
    """

    camera: Camera
    subject: Bools
    outside: Bools
    standing: Bools
    lying: Bools
    looks: Array | None
    lights: int

    @property
    def features(self) -> Array:
        """`looks`, which must have been measured."""
        assert self.looks is not None
        return self.looks

    def image(self, values: Array) -> Array:
        """`values (P,)` of the subject's pixels as an image `(H, W)`, 0 outside."""
        out = np.zeros(self.subject.shape)
        out[self.subject] = values
        return out

    def glossy(self) -> Bools:
        """Pixels `(H, W)` most of whose neighbours are as glossy as hair: clothes are not."""
        some = self.image(2.0 * (self.features[0] > FAINTEST_GLOSS)) - self.subject
        return np.asarray(ndimage.uniform_filter(some, _NEAR) > 0)

    @classmethod
    def of(cls, capture: Capture, camera: Camera, subject: Bools, geometry: MaskGeometry) -> _View:
        """The evidence from `geometry` and the OLAT frames of `capture`."""
        outside, covered = np.zeros((2, *subject.shape), bool)
        if geometry.head is not None:
            depth = mesh_depth(camera, geometry.head)
            covered = np.isfinite(depth)
            outside = subject & ~_beside(covered, camera, depth[covered])
        off, on = geometry.votes(camera)
        standing, lying = subject & (off > on), subject & covered & (on > off)
        features = looks(capture, camera.name, subject)
        lights = sum(capture.has_light(n, camera.name) for n in capture.olat_lights())
        return cls(camera, subject, outside, standing, lying, features, lights)

    def mask(self, hair: Bools, source: Source, decided: float) -> HairMask:
        """The mask with `hair (H, W)` restricted to the subject."""
        hair = hair & self.subject
        return HairMask(self.subject, hair, self.subject & ~hair, source, decided)

    def whole(self) -> HairMask:
        """The mask in which the whole subject is hair."""
        return self.mask(self.subject, "silhouette", 0.0)

    def by_points(self) -> HairMask:
        """The mask by geometry alone: pixels without a point follow their neighbours."""
        hair = self.outside | self.standing
        skin = self.lying & ~hair
        source: Source = "geometry" if (self.standing | self.lying).any() else "geometry alone"
        if not (hair | skin).any():
            return self.mask(self.subject, source, 0.0)
        decided = float((hair | skin).sum() / self.subject.sum())
        return self.mask(_fill(self.subject, hair, skin), source, decided)


def _by_looks(views: list[_View], geometry: MaskGeometry) -> dict[str, HairMask]:
    """Masks of `views` by reflectance; none if it forms one cluster and there are no examples.

    The classes are estimated from all cameras together. A pixel's score is its own plus half the
    mean score of its surface point over all cameras. What lies off the head and is not matte is an
    example of hair, and certainly hair if gloss or reflectance is no evidence.
    """
    if not views:
        return {}
    measured = min(v.lights for v in views) >= MATTE_LIGHTS
    pixels = np.concatenate([v.features.T for v in views])
    off = [v.outside | v.standing for v in views]
    hair = [o & v.glossy() if measured else o for o, v in zip(off, views, strict=True)]
    if sum(h.sum() for h in hair) < _FEWEST_GLOSSY * sum(o.sum() for o in off):
        hair = off
    examples = np.concatenate([h[v.subject] for h, v in zip(hair, views, strict=True)])
    if examples.any():
        classes: TwoClasses | None = two_classes(pixels, examples, measured)
    else:
        classes = clear_classes(pixels, measured)
    if classes is None:
        return {}
    source: Source = "reflectance" if geometry.head is None else "geometry"
    if not classes.weights.any():
        source = "geometry alone"
    prior = [v.standing | v.outside if measured else v.standing for v in views]
    scores = [v.image(classes.scores(v.features)) + p for v, p in zip(views, prior, strict=True)]
    places = [positions(v.camera, v.subject, geometry) for v in views]
    common = _by_place(places, scores)
    out = {}
    for view, known, score, place in zip(views, hair, scores, common, strict=True):
        near = ndimage.gaussian_filter(view.subject.astype(np.float64), 0.5)
        certain = view.outside & known & (source == "geometry alone" or not measured)
        total = np.where(certain, 6.0, score + 0.5 * place) * view.subject
        smooth = ndimage.gaussian_filter(total, 0.5) / np.maximum(near, 1e-9)
        out[view.camera.name] = view.mask(smooth > 0, source, 1.0)
    return out


def _by_place(places: list[Array], scores: list[Array]) -> list[Array]:
    """The mean of `scores (H, W)` over all cameras near each pixel's surface point, else 0.

    Averaged in cells of `_PLACE` metres with Gaussian weights of the same width.
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
    """Record `disagreements` in the report; warn above `MOST_DISAGREEMENT`."""
    found = disagreements(masks, capture.rig.cameras, points, head)
    stage.figures["disagreement"] = found
    if doubted := {k: v for k, v in found.items() if v > MOST_DISAGREEMENT}:
        shares = ", ".join(f"{name} {share:.0%}" for name, share in doubted.items())
        stage.warn(
            "hair masks disagree between cameras; share of pixels that other cameras classify "
            f"differently: {shares}; inspect masks/, provide hair masks for these cameras or check "
            "their poses"
        )


def disagreements(
    masks: Mapping[str, HairMask],
    cameras: Sequence[Camera],
    points: PointCloud | None = None,
    head: Mesh | None = None,
) -> dict[str, float]:
    """By camera, the share of its pixels that other cameras classify differently.

    Pixels are compared in cells of `_SAME_PLACE` metres on the surface, located by the camera's own
    triangulated points or else the head. At least three in four of the other cameras' pixels in the
    cell must differ, since cells at a hairline hold both. Cameras with under 100 compared pixels
    are omitted.
    """
    geometry = MaskGeometry(points, head, None)
    cells, hairs, owners = [], [], []
    for number, camera in enumerate(c for c in cameras if c.name in masks):
        mask = masks[camera.name]
        place = positions(camera, mask.subject, geometry)
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


def _reaches_edges(subject: Bools) -> bool:
    """Whether the `subject (H, W)` covers half of the image's edges."""
    return bool(2 * subject[edges(subject)].sum() > edges(subject).sum())


def _beside(covered: Bools, camera: Camera, depth: Array) -> Bools:
    """Pixels `(H, W)` that the head covers, grown by `OUTLINE` at the median of `depth (P,)`."""
    if not covered.any():
        return covered
    pixels = max(1.0, OUTLINE * camera.K[0, 0] / float(np.median(depth)))
    return np.asarray(ndimage.distance_transform_edt(~covered) <= pixels)


def _fill(subject: Bools, hair: Bools, skin: Bools) -> Bools:
    """Hair over the whole subject: undecided pixels follow decided ones, specks are removed."""
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
