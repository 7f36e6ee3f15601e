"""3D directions of hair at surface points, from the texture in all cameras."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from reconstruction.arrays import AnyFloats, Array, Bools, Floats, Ints
from reconstruction.geometry.cameras import Camera

NEARLY_PARALLEL = 0.1
"""`spread` below which a line is undetermined: its planes cross at some ten degrees."""


FINER = 8
"""Angles between two of the bank: 0.9 degrees for 24 filters."""

_ROWS = 20_000  # scores processed at once


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
    """Texture of one camera at its P visible points.

    `index (P,)` into the points, `pixels (P, 2)` their projections, `support (P, K)` of image lines
    at k · 180°/K, of mean 0 over the angles.
    """

    camera: Camera
    index: Ints
    pixels: Array
    support: Floats

    @classmethod
    def of(cls, camera: Camera, support: Floats, points: AnyFloats, visible: Bools) -> LineEvidence:
        """From `support (K, H, W)` at those of `points (N, 3)` that are `visible (N,)`."""
        index = np.flatnonzero(visible)
        pixels, _ = camera.project(points[index])
        x, y = np.rint(pixels).astype(int).T
        return cls(camera, index, pixels, support[:, y, x].T)

    def part(self, which: slice) -> LineEvidence:
        """The evidence at some of its points."""
        return LineEvidence(self.camera, self.index[which], self.pixels[which], self.support[which])


def line_support(responses: AnyFloats) -> Floats:
    """Support `(K, H, W)`: filter `responses (K, H, W)` relative to their mean, minus 1."""
    mean = responses.mean(axis=0)
    floor = 0.05 * float(mean.mean()) + 1e-30
    return np.asarray((responses - mean) / (mean + floor), np.float32)


def visible_from(camera: Camera, depth: AnyFloats, points: AnyFloats, tolerance: float) -> Bools:
    """Whether `points (N, 3)` are at most `tolerance` metres behind a known `depth (H, W)`."""
    on, x, y, far = camera.pixels_of(points)
    there = depth[y, x]
    return np.asarray(on & (there > 0) & (far <= there + tolerance))


def finer(support: AnyFloats) -> Floats:
    """Support `(N, 8 K)` at eight times as many angles as `support (N, K)`, by Fourier series."""
    count = support.shape[1]
    series = np.fft.rfft(support, axis=1)
    if count % 2 == 0:
        series[:, -1] /= 2  # the Nyquist frequency is its own mirror
    many = np.fft.irfft(series, FINER * count, axis=1)
    return np.asarray(FINER * many, np.float32)


def line_scores(evidence: LineEvidence, candidates: Array) -> Floats:
    """Support `(P, D)` of each of `candidates (D, 3)` at a camera's P points.

    Looked up at the angle of the candidate's projection, weighted by the squared sine of its angle
    to the viewing ray.
    """
    parts = range(0, len(evidence.index), _ROWS)
    scored = [_line_scores(evidence.part(slice(k, k + _ROWS)), candidates) for k in parts]
    return np.concatenate(scored or [np.zeros((0, len(candidates)), np.float32)])


def _line_scores(evidence: LineEvidence, candidates: Array) -> Floats:
    camera = evidence.camera
    rays = camera.rays(evidence.pixels)
    # the projection of direction t at a pixel is the image velocity of X + s t, up to its length
    local = rays @ camera.R.T
    xy = (local[:, :2] / local[:, 2:]).astype(np.float32)
    t = (candidates @ camera.R.T).astype(np.float32)
    flow = t[None, :, :2] - xy[:, None] * t[None, :, 2:]
    u = camera.K[0, 0] * flow[..., 0] + camera.K[0, 1] * flow[..., 1]
    v = camera.K[1, 1] * flow[..., 1]
    support = finer(evidence.support)
    count = support.shape[1]
    bins = np.rint(np.arctan2(v, u) * (count / np.pi)).astype(np.int64) % count
    sine2 = 1 - (rays.astype(np.float32) @ candidates.T.astype(np.float32)) ** 2
    return np.asarray(sine2 * np.take_along_axis(support, bins, axis=1), np.float32)


@dataclass(frozen=True, eq=False)
class Tangents:
    """Undirected unit `directions (N, 3)` and `confidence (N,)` in [0, 1].

    Confidence is the difference of the two largest eigenvalues of the mean structure tensor over
    the candidates, weighted by their scores: 1 for a single direction, 0 for two or more.
    """

    directions: Array
    confidence: Array


def deviation_deg(confidence: AnyFloats) -> Array:
    """Standard deviation, degrees, of directions with that `Tangents.confidence` c, of any shape.

    Of a normal distribution about one direction: the two smaller eigenvalues are the variance s²,
    so that c = 1 − 3 s². From 0 for c = 1 to 33 for c = 0, no direction at all.
    """
    return np.degrees(np.sqrt((1 - np.asarray(confidence, np.float64)) / 3))


def decide(scores: AnyFloats, candidates: Array) -> Tangents:
    """The best direction for each row of `scores (N, D)` over `candidates (D, 3)`.

    Softmax weights, of the median standard deviation of the rows over 2 as temperature. The
    direction is the principal axis of the weighted structure tensor of candidates near the best.
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
    """Conditioning of each point's line `(N,)` by the planes through its images (Sun Eq. 4).

    `views` counts the views with an orientation there. With the singular values s1 >= s2 >= s3 of
    the weighted plane normals: `spread` is s2 / s1, 0 for parallel planes; `misfit` is s3 / s2, 0
    where all planes meet in one line.
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

    A view's line is the mean of its support over doubled angles, weighted by that mean's length;
    views below `least_confidence` do not count.
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
    misfit = np.divide(values[:, 0], values[:, 1], out=none, where=spread > 1e-6)
    return LineConditioning(views, spread, misfit)
