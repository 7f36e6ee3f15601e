"""Which pixels are hair and which are skin: the user's word, else geometry, else the light.

Hair is wherever the user's mask says so, or else the user's network, of what is lit. Without one,
a pixel whose triangulated point stands off the head, or that shows the subject where the head is
not, is hair. On the head, the light
decides. Without a head mesh, the light and the fineness of the lines do (`hair_features`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from reconstruction.arrays import Array, Bools
from reconstruction.capture.folder import Capture, CaptureError
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_queries import mesh_depth
from reconstruction.images.hair_features import (
    FAINTEST_LINES,
    light_contrast,
    line_strength,
    otsu,
    tell_apart,
)
from reconstruction.images.segmentation import Network
from reconstruction.images.silhouettes import NoSilhouette, lit_image, lit_rgb, silhouette
from reconstruction.light_planes.point_cloud import PointCloud
from reconstruction.report.report import Stage

Source = Literal["user", "network", "geometry", "light and lines", "lines", "silhouette"]

STANDS_OFF = 4e-3  # metres that a point must be off the head to be hair


@dataclass(frozen=True, eq=False)
class HairMask:
    """One camera's pixels `(H, W) bool`: `subject` is the union of `hair` and `skin`, no overlap.

    `source` says who told hair from skin; `decided` is the share of the subject that it decided,
    the rest follows its neighbours.
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


def hair_masks(
    capture: Capture,
    points: PointCloud | None = None,
    head: Mesh | None = None,
    *,
    network: Network | None = None,
) -> dict[str, HairMask]:
    """Masks of every camera that has a user's mask or a silhouette.

    `network` is asked where the user gave no mask. `points` are in the reference pose, `head` the
    digitised head in the world. A camera without any frame to take a silhouette from, and without
    a user's mask, is left out. An empty silhouette gives empty masks.
    """
    off = None
    if head is not None and points is not None and len(points):
        off = distance_to(head, points.points)
    masks, unknown = {}, {}
    for camera in capture.rig.cameras:
        user = capture.mask(camera.name)
        try:
            subject = silhouette(capture, camera.name)
        except NoSilhouette:
            if user is None:
                continue
            subject = user
        if user is not None:
            masks[camera.name] = HairMask(subject | user, user, subject & ~user, "user", 1.0)
        elif network is not None:
            hair = network.hair_pixels(lit_rgb(capture, camera.name)) & subject
            masks[camera.name] = HairMask(subject, hair, subject & ~hair, "network", 1.0)
        elif not subject.any():
            masks[camera.name] = HairMask(subject, subject, subject, "silhouette", 0.0)
        elif head is not None:
            masks[camera.name] = _decide(capture, camera, subject, points, head, off)
        else:
            unknown[camera.name] = subject
    return masks | _by_looks(capture, unknown)


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
    if not any(mask.hair.any() for mask in out.values()):
        raise CaptureError(
            f"{capture.path}: no pixel of any camera is hair: check the lights, the cameras' poses "
            "and, where given, the hair masks"
        )
    if len(out) < 2:
        raise CaptureError(f"{capture.path}: only {', '.join(out)} sees the subject, not two")
    return out


def _by_looks(capture: Capture, subjects: dict[str, Bools]) -> dict[str, HairMask]:
    """Masks from light and lines alone; where these show one class, all of it may be hair."""
    features = {}
    for name, subject in subjects.items():
        contrast = light_contrast(capture, name, subject)
        lines = line_strength(lit_image(capture, name), subject)
        features[name] = lines[None] if contrast is None else np.stack([contrast, lines])
    out = {}
    for count in {len(f) for f in features.values()}:
        group = {name: f for name, f in features.items() if len(f) == count}
        scores = tell_apart(group, subjects)
        if scores is not None and count == 1:
            hairs = [f[0][subjects[n] & (scores[n] > 0)] for n, f in group.items()]
            if np.median(np.concatenate(hairs)) < FAINTEST_LINES:
                scores = None  # what stands out is an outline, or noise
        for name in group:
            subject = subjects[name]
            if scores is None:
                nothing = np.zeros_like(subject)
                out[name] = HairMask(subject, subject, nothing, "silhouette", 0.0)
                continue
            hair = subject & (scores[name] > 0)
            hair = _fill(subject, hair, subject & ~hair)
            source: Source = "light and lines" if count == 2 else "lines"
            out[name] = HairMask(subject, hair, subject & ~hair, source, 1.0)
    return out


def _decide(
    capture: Capture,
    camera: Camera,
    subject: Bools,
    points: PointCloud | None,
    head: Mesh,
    off: Array | None,
) -> HairMask:
    """A mask from where points lie on the head, and from the light where they lie on it."""
    contrast = light_contrast(capture, camera.name, subject)
    covered = np.isfinite(mesh_depth(camera, head))
    hair, skin = subject & ~ndimage.binary_dilation(covered), np.zeros_like(subject)
    if points is not None and off is not None:
        standing, lying = _votes(points, camera, off)
        hair |= subject & (standing > lying)
        skin |= subject & covered & (lying > standing) & ~hair
    if contrast is not None:
        # a point on the head may be hair that lies flat, and one may be missing: ask the light
        level = _threshold(contrast, subject, hair, skin)
        asked = (skin | (subject & covered)) & ~hair
        hair |= asked & (contrast > level)
        skin |= asked & ~hair
        skin &= ~hair
    decided = float((hair | skin).sum() / subject.sum())
    if not (hair | skin).any():
        # nothing told them apart: all of the subject may be hair
        return HairMask(subject, subject, np.zeros_like(subject), "geometry", 0.0)
    hair = _fill(subject, hair, skin)
    return HairMask(subject, hair, subject & ~hair, "geometry", decided)


def _votes(points: PointCloud, camera: Camera, off: Array) -> tuple[Array, Array]:
    """Weights of the points that stand off the head and that lie on it, per pixel `(H, W)`.

    The camera's own points, none where it took no part in the triangulation.
    """
    own = points.cameras.index(camera.name) if camera.name in points.cameras else -1
    mine = points.camera == own
    seen, x, y, _ = camera.pixels_of(points.points[mine])
    flat = (y * camera.width + x)[seen]
    weight, standing = points.weight[mine][seen], off[mine][seen] > STANDS_OFF

    def votes(which: Bools) -> Array:
        size = camera.height, camera.width
        total: Array = np.bincount(flat[which], weight[which], size[0] * size[1]).astype(float)
        return total.reshape(size)

    return votes(standing), votes(~standing)


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


def _threshold(contrast: Array, subject: Bools, hair: Bools, skin: Bools) -> float:
    """The contrast above which a pixel is hair: between what sure hair and likely skin have.

    The split of the whole subject where one of them is missing. Where the two do not differ by a
    third, likely skin is hair that lies flat on the head if sure hair is far from matte: what
    equals it is hair, too. Else the light cannot tell: infinite, so that none is hair.
    """
    if not hair.any() or not skin.any():
        return otsu(contrast[subject])[0]
    third = np.log(4 / 3)
    sure, likely = float(np.median(contrast[hair])), float(np.median(contrast[skin]))
    if sure > likely + third:
        return 0.5 * (sure + likely)
    return sure - third if sure > 2 * third else np.inf


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
