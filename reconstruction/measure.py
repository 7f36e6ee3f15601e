"""Measured tangents: what the OLAT frames say about the hair at points of its surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reconstruction.capture import Capture, CaptureError
from reconstruction.lights import Light
from reconstruction.masks import HairMask
from reconstruction.orientation import LogGaborBank, texture
from reconstruction.report import Progress, Stage, silent
from reconstruction.tangents import (
    LineEvidence,
    decide,
    half_sphere,
    line_scores,
    line_support,
    pool,
    seen_by,
)
from reconstruction.visual_hull import VoxelGrid

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MeasureOptions:
    """How tangents are measured.

    The `bank` answers to pictures under `light_groups` groups of neighbouring lights, which show
    different fibres; `candidates` directions are scored at each point, averaged over `radius`
    metres. Points closer than `thin` metres are merged first. `tolerance` (metres) is how far
    behind a camera's own depth a point may lie and still count as seen.
    """

    bank: LogGaborBank = LogGaborBank(wavelength=6.0, count=24, spread=1.0)  # noqa: RUF009
    texture_scale: float = 5.0
    light_groups: int = 24
    candidates: int = 600
    radius: float = 12e-3
    neighbours: int = 48
    thin: float = 1.5e-3
    tolerance: float = 4e-3


@dataclass(frozen=True, eq=False)
class Measured:
    """Lines at surface points: `points (N, 3)`, `directions (N, 3)`, `confidence (N,)`."""

    points: Array
    directions: Array
    confidence: Array


def light_groups(lights: list[Light], count: int) -> NDArray[np.int64]:
    """Group number `(L,)` of each light: nearest of `count` seeds spread over the lights.

    Seeds are chosen one after the other, each the light furthest from all before it, then moved
    to the middle of their lights twice; no randomness.
    """
    p = np.stack([light.position / np.linalg.norm(light.position) for light in lights])
    count = min(count, len(p))
    seeds = [0]
    distance = np.linalg.norm(p - p[0], axis=1)
    for _ in range(count - 1):
        seeds.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(p - p[seeds[-1]], axis=1))
    centers = p[seeds]
    for _ in range(3):
        group = np.linalg.norm(p[:, None] - centers, axis=2).argmin(axis=1)
        for k in np.unique(group):
            centers[k] = p[group == k].mean(axis=0)
    return np.asarray(group, np.int64)


def measure_tangents(
    capture: Capture,
    points: Array,
    masks: Mapping[str, HairMask],
    depths: Mapping[str, Array],
    envelope: VoxelGrid,
    options: MeasureOptions = MeasureOptions(),  # noqa: B008  frozen
    stage: Stage | None = None,
    progress: Progress = silent,
) -> Measured:
    """Directions at the triangulated `points (N, 3)`, or where there are none, at the depths'.

    `depths[camera] (H, W)` are those of the hair pixels, metres along z. Raises `CaptureError` for
    a capture without OLAT frames.
    """
    stage = stage or Stage("orientation")
    names = capture.olat_lights()
    if not names:
        raise CaptureError(f"{capture.path}: no OLAT frames, which the orientations come from")
    group = light_groups([capture.rig.light(n) for n in names], options.light_groups)
    cameras = [c for c in capture.rig.cameras if c.name in masks and masks[c.name].hair.any()]
    evidences = []
    for done, camera in enumerate(cameras):
        progress("orientation", done / len(cameras))
        mask = masks[camera.name].hair
        olat = capture.olat(camera.name, names).mean(axis=-1)
        total = np.zeros((options.bank.count, *mask.shape), np.float32)
        for g in np.unique(group):
            total += options.bank.responses(
                texture(olat[group == g].sum(axis=0), mask, options.texture_scale)
            )
        evidences.append(LineEvidence(camera, line_support(total), mask, depths[camera.name]))
    if not len(points):
        points = np.concatenate([_lifted(e) for e in evidences])
    points = thinned(points, options.thin)
    seen_any = np.zeros(len(points), bool)
    directions = half_sphere(options.candidates)
    scores = np.zeros((len(points), options.candidates), np.float32)
    views = np.zeros(len(points), np.int64)
    for evidence in evidences:
        seen = seen_by(evidence, points, options.tolerance)
        scores += line_scores(evidence, points, directions, seen)
        views += seen
    seen_any = views > 0
    points, scores, views = points[seen_any], scores[seen_any], views[seen_any]
    tangents = decide(pool(points, options.radius, options.neighbours) @ scores, directions)
    stage.figures.update(
        points=len(points),
        cameras_per_point={str(k): int(n) for k, n in enumerate(np.bincount(views)) if n},
        confidence={f"p{q}": float(np.percentile(tangents.confidence, q)) for q in (10, 50, 90)}
        if len(points)
        else {},
    )
    return Measured(points, tangents.directions, tangents.confidence)


def _lifted(evidence: LineEvidence) -> Array:
    y, x = np.nonzero(evidence.mask & (evidence.depth > 0))
    camera = evidence.camera
    rays = camera.rays(np.stack([x, y], axis=1))
    along = rays @ camera.R[2]
    return camera.center + rays * (evidence.depth[y, x] / along)[:, None]


def thinned(points: Array, spacing: float) -> Array:
    """The means of the points in each cell of `spacing` metres `(M, 3)`."""
    _, member, count = np.unique(
        np.floor(points / spacing).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    member = member.ravel()
    sums = np.stack([np.bincount(member, p, len(count)) for p in points.T], axis=1)
    return np.asarray(sums / count[:, None])
