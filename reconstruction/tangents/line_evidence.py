"""3D directions of hair at surface points, from every camera that sees them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from reconstruction.arrays import AnyFloats, Array, Bools, Floats, Ints
from reconstruction.geometry.cameras import Camera

NEARLY_PARALLEL = 0.1
"""`spread` under which a line may turn freely within the planes: they cross at some ten degrees."""


FINER = 8
"""Angles at which support is looked up between two of the bank: 0.9 degrees for 24 filters."""

_ROWS = 20_000  # of scores that are made or decided at once: they take several times their memory


def half_sphere(count: int) -> Array:
    """`count` nearly evenly spaced unit vectors `(N, 3)` of the half sphere z >= 0."""
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    z = (np.arange(count) + 0.5) / count
    azimuth = np.arange(count) * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], axis=1)


@dataclass(frozen=True, eq=False)
class LineEvidence:
    """What one camera's texture says at the P points that it sees.

    `index (P,)` into the points, `pixels (P, 2)` where they lie in the image, `support (P, K)` for
    lines at k · 180°/K there. Positive support speaks for an angle, negative against it; its mean
    over the angles is 0, so that a pixel without texture says nothing.
    """

    camera: Camera
    index: Ints
    pixels: Array
    support: Floats

    @classmethod
    def of(cls, camera: Camera, support: Floats, points: AnyFloats, seen: Bools) -> LineEvidence:
        """Of an image of `support (K, H, W)`, at those of `points (N, 3)` that are `seen (N,)`."""
        index = np.flatnonzero(seen)
        pixels, _ = camera.project(points[index])
        x, y = np.rint(pixels).astype(int).T
        return cls(camera, index, pixels, support[:, y, x].T)

    def part(self, which: slice) -> LineEvidence:
        """What it says at some of its points."""
        return LineEvidence(self.camera, self.index[which], self.pixels[which], self.support[which])


def line_support(responses: AnyFloats) -> Floats:
    """Support `(K, H, W)` from a filter bank's answers `(K, H, W)`: their excess over the mean.

    Normalised by the mean over angles, so that contrast does not count twice.
    """
    mean = responses.mean(axis=0)
    floor = 0.05 * float(mean.mean()) + 1e-30
    return np.asarray((responses - mean) / (mean + floor), np.float32)


def seen_by(camera: Camera, depth: AnyFloats, points: AnyFloats, tolerance: float) -> Bools:
    """Points `(N,)` that project to where `depth (H, W)` is known (not 0), at no more than
    `tolerance` behind it; metres along the camera's z."""
    on, x, y, far = camera.pixels_of(points)
    there = depth[y, x]
    return np.asarray(on & (there > 0) & (far <= there + tolerance))


def finer(support: AnyFloats) -> Floats:
    """Support `(N, 8 K)` at eight times as many angles as `support (N, K)`, by Fourier's series.

    A bank's answer is smooth in the angle and has a period of half a turn: the peak between two
    bins comes out where it is.
    """
    count = support.shape[1]
    series = np.fft.rfft(support, axis=1)
    if count % 2 == 0:
        series[:, -1] /= 2  # the highest frequency stands for itself and its mirror
    many = np.fft.irfft(series, FINER * count, axis=1)
    return np.asarray(FINER * many, np.float32)


def line_scores(evidence: LineEvidence, candidates: Array) -> Floats:
    """Support `(P, D)` that a camera's texture gives each of `candidates (D, 3)` at its P points.

    A candidate is looked up at the angle of its projection and weighted by the squared sine of
    its angle to the viewing ray: a line along the ray is a dot that no texture speaks about.
    Between the bank's angles support runs as its Fourier series does.
    """
    parts = range(0, len(evidence.index), _ROWS)
    scored = [_line_scores(evidence.part(slice(k, k + _ROWS)), candidates) for k in parts]
    return np.concatenate(scored or [np.zeros((0, len(candidates)), np.float32)])


def _line_scores(evidence: LineEvidence, candidates: Array) -> Floats:
    camera = evidence.camera
    rays = camera.rays(evidence.pixels)
    # The projection of direction t at a pixel: the image velocity of X + s t, up to its length.
    local_ray = rays @ camera.R.T
    slope = local_ray[:, :2] / local_ray[:, 2:]
    t = (candidates @ camera.R.T).astype(np.float32)
    flow = t[None, :, :2] - slope[:, :, None].transpose(0, 2, 1).astype(np.float32) * t[None, :, 2:]
    u = camera.K[0, 0] * flow[..., 0] + camera.K[0, 1] * flow[..., 1]
    v = camera.K[1, 1] * flow[..., 1]
    support = finer(evidence.support)
    count = support.shape[1]
    bins = np.rint(np.arctan2(v, u) * (count / np.pi)).astype(np.int64) % count
    sine2 = 1 - (rays.astype(np.float32) @ candidates.T.astype(np.float32)) ** 2
    return np.asarray(sine2 * np.take_along_axis(support, bins, axis=1), np.float32)


def pool(points: AnyFloats, radius: float, most: int = 24) -> sparse.csr_array:
    """Weights `(N, N)` that average over neighbours within `radius` metres: a Gaussian of half it.

    Each row sums to 1. At most `most` neighbours count. They are single, as scores are: double ones
    would make a double copy of all scores, and of the means.
    """
    if not len(points):
        return sparse.csr_array((0, 0), dtype=np.float32)
    k = min(most, len(points))
    distance, index = cKDTree(points).query(points, k=np.arange(1, k + 1))
    weight = np.where(distance <= radius, np.exp(-2 * (distance / radius) ** 2), 0)
    weight /= weight.sum(axis=1, keepdims=True)
    rows = np.repeat(np.arange(len(points)), k)
    table = sparse.csr_array(
        (weight.astype(np.float32).ravel(), (rows, index.ravel())), shape=(len(points), len(points))
    )
    table.eliminate_zeros()
    return table


@dataclass(frozen=True, eq=False)
class Tangents:
    """Undirected unit `directions (N, 3)` and `confidence (N,)` in [0, 1].

    Confidence is the difference of the two largest eigenvalues of the mean structure tensor over
    the candidates, weighted by how well each explains the images: 1 when one direction stands
    alone, 0 when two or more do as well.
    """

    directions: Array
    confidence: Array


def decide(scores: AnyFloats, candidates: Array) -> Tangents:
    """The best direction for each row of `scores (N, D)` over `candidates (D, 3)`.

    Scores are turned into weights by a softmax whose temperature is their median spread over the
    rows divided by 6. The direction is the main axis of the weighted
    structure tensor of the candidates near the best one: finer than their spacing.
    """
    if scores.shape != (len(scores), len(candidates)):
        raise ValueError(f"scores must be (N, {len(candidates)}), got {scores.shape}")
    if not len(scores):
        return Tangents(np.zeros((0, 3)), np.zeros(0))
    parts = np.array_split(scores, -(-len(scores) // _ROWS))
    spread = float(np.median(np.concatenate([part.std(axis=1) for part in parts]))) + 1e-12
    decided = [_decided(part, candidates, spread) for part in parts]
    return Tangents(*(np.concatenate(x) for x in zip(*decided, strict=True)))


def _decided(scores: AnyFloats, candidates: Array, spread: float) -> tuple[Array, Array]:
    """Directions `(N, 3)` and confidences `(N,)` of some rows."""
    weights = np.exp(6.0 * (scores - scores.max(axis=1, keepdims=True)) / spread / 3)
    pair = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    basis = np.stack([candidates[:, i] * candidates[:, j] for i, j in pair], axis=1)
    total = weights.sum(axis=1, keepdims=True)
    values = np.linalg.eigvalsh(_full(weights @ basis / total))
    confidence = values[:, 2] - values[:, 1]
    best = candidates[scores.argmax(axis=1)]
    near = weights * np.clip((best @ candidates.T) ** 2 * 16 - 15, 0, 1)  # within about 14 degrees
    _, vectors = np.linalg.eigh(_full(near @ basis))
    direction = vectors[:, :, 2]
    direction *= np.where((direction * best).sum(axis=1) < 0, -1, 1)[:, None]
    flat = np.ptp(scores, axis=1) <= 0
    return direction, np.where(flat, 0.0, np.clip(confidence, 0, 1))


def _full(tensors: AnyFloats) -> Array:
    full = np.empty((len(tensors), 3, 3))
    for n, (i, j) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]):
        full[:, i, j] = full[:, j, i] = tensors[:, n]
    return full


@dataclass(frozen=True, eq=False)
class LineConditioning:
    """Of each point's line `(N,)`, from the planes through its images in the views that see it.

    `views` counts the views whose texture has an orientation there. With the singular values
    s1 >= s2 >= s3 of the planes' normals, weighted: `spread` is s2 / s1, from 0 where all planes
    are parallel (or there is only one) to 1; `misfit` is s3 / s2, 0 where all planes meet in one
    line, as two always do (Sun Eq. 4; Photobooth §3.2 takes the two most frontal views alone).
    """

    views: Ints
    spread: Array
    misfit: Array

    def figures(self) -> dict[str, Any]:
        """Counts of views, percentiles, and the share of undetermined lines, JSON-ready."""
        if not len(self.views):
            return {"views_per_point": {}, "undetermined_share": 0.0}
        determined = self.spread >= NEARLY_PARALLEL
        several = self.views > 2

        def percentiles(values: Array) -> dict[str, float] | None:
            if not len(values):
                return None
            return {f"p{q}": float(np.percentile(values, q)) for q in (10, 50, 90)}

        return {
            "views_per_point": {str(k): int(n) for k, n in enumerate(np.bincount(self.views)) if n},
            "spread": percentiles(self.spread[self.views > 1]),
            "misfit": percentiles(self.misfit[several & determined]),
            "undetermined_share": float((~determined).mean()),
        }


def condition_lines(
    evidences: Iterable[LineEvidence], count: int, *, least_confidence: float = 0.1
) -> LineConditioning:
    """Conditioning of the lines at `count` points.

    A view's line is the mean of its support over doubled angles, and its weight that mean's length:
    0 where all angles answer alike, near 1 for a single one. Views below `least_confidence` do not
    count.
    """
    moments = np.zeros((count, 3, 3))
    views = np.zeros(count, np.int64)
    for evidence in evidences:
        camera, pixels, which = evidence.camera, evidence.pixels, evidence.index
        bins = evidence.support.shape[1]
        mean = evidence.support @ np.exp(2j * np.pi * np.arange(bins) / bins) / bins
        along = 0.5 * np.angle(mean)
        ahead = camera.rays(pixels + np.stack([np.cos(along), np.sin(along)], axis=1))
        normal = np.cross(camera.rays(pixels), ahead)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        weight = np.abs(mean)
        weight = np.where(weight >= least_confidence, np.minimum(weight, 1), 0.0)
        moments[which] += weight[:, None, None] * normal[:, :, None] * normal[:, None, :]
        views[which] += weight > 0
    values = np.sqrt(np.maximum(np.linalg.eigvalsh(moments), 0))
    none = np.zeros(count)
    spread = np.divide(values[:, 1], values[:, 2], out=none.copy(), where=views > 1)
    # what rounding leaves of parallel planes says nothing about where they meet
    misfit = np.divide(values[:, 0], values[:, 1], out=none, where=spread > 1e-6)
    return LineConditioning(views, spread, misfit)
