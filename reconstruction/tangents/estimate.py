"""Measured tangents: what the OLAT frames say about the hair at points of its surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from reconstruction.arrays import Array, Bools, Floats, Ints
from reconstruction.capture.folder import Capture, CaptureError
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lights import Light
from reconstruction.images.grey import grey
from reconstruction.images.orientation import responses, texture
from reconstruction.masks import MaskedCapture
from reconstruction.reconstruct_options import MeasureOptions
from reconstruction.report.report import Progress, Stage, silent
from reconstruction.tangents.line_evidence import (
    LineEvidence,
    condition_lines,
    decide,
    half_sphere,
    line_scores,
    line_support,
    pool,
    seen_by,
)
from reconstruction.tangents.reflection import (
    FEWEST_LIGHTS,
    Answers,
    observe,
    reflection_scores,
    surface_normals,
)

CANDIDATES = 500  # directions that are scored at each point
MOST_SATURATED = 0.1
ROUNDS = 2  # of reading reflections: the second with a table that the first one's directions fill
LIGHT_GROUPS = 24  # of neighbouring lights; the texture of each shows different fibres


@dataclass(frozen=True, eq=False)
class Measured:
    """Lines at surface points: `points (N, 3)`, `directions (N, 3)`, `confidence (N,)`."""

    points: Array
    directions: Array
    confidence: Array

    @classmethod
    def none(cls) -> Measured:
        """No line at all."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))

    def where(self, keep: Bools) -> Measured:
        """Those that are to be kept `(N,)`."""
        return Measured(self.points[keep], self.directions[keep], self.confidence[keep])


def light_groups(lights: list[Light], count: int) -> Ints:
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


def read_answers(capture: Capture, camera: Camera, lights: Sequence[str]) -> Answers:
    """What `camera` saw under each of `lights` alone; what is missing or saturated is not known."""
    olat = np.zeros((len(lights), camera.height, camera.width), np.float32)
    known = np.zeros(olat.shape, bool)
    for i, name in enumerate(lights):
        if capture.has_light(name, camera.name):
            image, saturated = capture.light(name, camera.name)
            olat[i], known[i] = grey(image), ~saturated
    return Answers(camera, olat, known)


@dataclass
class Saturation:
    """How much of what hair answered to lights is left out as saturated."""

    asked: int = 0
    saturated: int = 0

    def add(self, answers: Answers, hair: Bools) -> None:
        """Count one camera's on its `hair (H, W)`."""
        known = answers.known[answers.shot][:, hair]
        self.asked += known.size
        self.saturated += known.size - int(known.sum())

    def tell(self, stage: Stage) -> None:
        """Leave the share in the report; warn where it is much."""
        share = self.saturated / max(self.asked, 1)
        stage.figures["saturated"] = share
        if share > MOST_SATURATED:
            stage.warn(
                f"{share:.0%} of the hair's answers to single lights are saturated and left out: "
                "shoot them at a shorter exposure too"
            )


def measure_tangents(
    masked: MaskedCapture,
    points: Array,
    depths: Mapping[str, Array],
    options: MeasureOptions = MeasureOptions(),
    stage: Stage | None = None,
    progress: Progress = silent,
) -> Measured:
    """Directions at the triangulated `points (N, 3)`, or where there are none, at the depths'.

    `depths[camera] (H, W)` are those of the hair pixels, metres along z. Raises `CaptureError` for
    a capture without OLAT frames.
    """
    stage = stage or Stage("orientation")
    capture = masked.capture
    names = capture.olat_lights()
    if not names:
        raise CaptureError(f"{capture.path}: no OLAT frames, which the orientations come from")
    lights = [capture.rig.light(n) for n in names]
    group = light_groups(lights, LIGHT_GROUPS)
    cameras = [c for c in masked.cameras if masked.masks[c.name].hair.any()]
    shown = [np.where(masked.masks[c.name].hair, depths[c.name], 0.0) for c in cameras]
    if not len(points):
        lifted = [_lifted(*view) for view in zip(cameras, shown, strict=True)]
        points = np.concatenate(lifted) if lifted else points
    points, seen = _seen(thinned(points, options.thin), cameras, shown, options.tolerance)
    if not len(points):
        raise CaptureError(f"{capture.path}: no surface point lies on a hair mask")
    reads = len(lights) >= FEWEST_LIGHTS
    normals = _normals(points, cameras, seen) if reads else None
    candidates = half_sphere(CANDIDATES)
    scores = np.zeros((len(points), CANDIDATES), np.float32)
    evidences, observations, left_out = [], [], Saturation()
    for k, camera in enumerate(cameras):  # one's frames at a time: they are what takes memory
        progress("texture", 0.6 * k / len(cameras))
        mask = masked.masks[camera.name].hair
        answers = read_answers(capture, camera, names)
        left_out.add(answers, mask)
        support = line_support(responses(options.bank, _details(answers, mask, group, options)))
        evidences.append(LineEvidence.of(camera, support, points, seen[:, k]))
        scores[evidences[-1].index] += line_scores(evidences[-1], candidates)
        if normals is not None:
            observations.append(observe(answers, lights, points, normals, seen[:, k]))
        del answers, support  # before the next one's are read
    left_out.tell(stage)
    stage.figures["lines"] = condition_lines(evidences, len(points)).figures()
    tangents = decide(pool(points, options.radius, options.neighbours) @ scores, candidates)
    if not reads:
        stage.leave_out(
            "directions from reflection",
            f"{len(lights)} lights, fewer than {FEWEST_LIGHTS}: highlights fall between them",
            "the second half of this stage; directions come from texture alone",
        )
    else:
        progress("reflection", 0.6)
        near = pool(points, options.reflection_radius, options.neighbours)
        texture_only, scores = tangents, near @ scores
        for _ in range(ROUNDS):
            more, table = reflection_scores(observations, points, candidates, tangents)
            tangents = decide(scores + options.reflection_weight * (near @ more), candidates)
        turned = np.abs((tangents.directions * texture_only.directions).sum(axis=1)).clip(0, 1)
        stage.figures["lobe_contrast"] = table.contrast
        stage.figures["turned_by_reflection_deg"] = float(np.median(np.degrees(np.arccos(turned))))
        if table.contrast < 1.3:
            stage.warn(
                f"the hair's highlight is only {table.contrast:.2f} times its surroundings: "
                "directions from reflection are weak"
            )
    stage.figures.update(
        points=len(points),
        cameras_per_point={
            str(k): int(n) for k, n in enumerate(np.bincount(seen.sum(axis=1))) if n
        },
        confidence={f"p{q}": float(np.percentile(tangents.confidence, q)) for q in (10, 50, 90)},
    )
    return Measured(points, tangents.directions, tangents.confidence)


def _details(answers: Answers, mask: Bools, group: Ints, options: MeasureOptions) -> Floats:
    """Textures `(G, H, W)` of the hair under each group of lights that were shot, one at least."""
    details = [
        texture(answers.olat[of].sum(axis=0), mask & whole, options.texture_scale)
        for g in np.unique(group)
        if (of := (group == g) & answers.shot).any()
        and (whole := answers.known[of].all(axis=0)).any()
    ]
    return np.stack(details or [np.zeros(mask.shape, np.float32)])


def _seen(
    points: Array, cameras: Sequence[Camera], depths: Sequence[Array], tolerance: float
) -> tuple[Array, Bools]:
    """Those of `points (N, 3)` that some camera sees, and which do, `(M, C)`."""
    seen = np.zeros((len(points), len(cameras)), bool)
    for k, (camera, depth) in enumerate(zip(cameras, depths, strict=True)):
        seen[:, k] = seen_by(camera, depth, points, tolerance)
    any_one = seen.any(axis=1)
    return points[any_one], seen[any_one]


def _normals(points: Array, cameras: Sequence[Camera], seen: Bools) -> Array:
    """Those of the points' surface `(N, 3)`, facing the cameras; `seen (N, C)` by which."""
    centers = np.stack([camera.center for camera in cameras])
    return surface_normals(points, seen @ centers - seen.sum(axis=1, keepdims=True) * points)


def _lifted(camera: Camera, depth: Array) -> Array:
    """The points `(P, 3)` that a `depth (H, W)` tells of, in the world's coordinates."""
    y, x = np.nonzero(depth > 0)
    rays = camera.rays(np.stack([x, y], axis=1))
    along = rays @ camera.R[2]
    return camera.center + rays * (depth[y, x] / along)[:, None]


def thinned(points: Array, spacing: float) -> Array:
    """The means of the points in each cell of `spacing` metres `(M, 3)`."""
    _, member, count = np.unique(
        np.floor(points / spacing).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    member = member.ravel()
    sums = np.stack([np.bincount(member, p, len(count)) for p in points.T], axis=1)
    return np.asarray(sums / count[:, None])
