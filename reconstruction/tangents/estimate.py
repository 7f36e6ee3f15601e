"""Tangents of the hair at surface points, measured in OLAT frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from reconstruction.arrays import Array, Bools, Floats, Ints
from reconstruction.capture.folder import Capture
from reconstruction.capture.records import CaptureError
from reconstruction.capture_scale import CaptureScale
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lights import Light
from reconstruction.images.grey import grey
from reconstruction.images.orientation import responses, textures
from reconstruction.images.silhouettes import NO_SINGLE_LIGHTS, lit_frame
from reconstruction.light_planes.point_cloud import PointCloud
from reconstruction.masks import MaskedCapture
from reconstruction.reconstruct_options import MeasureOptions
from reconstruction.report.report import Progress, Stage, silent
from reconstruction.tangents.line_evidence import (
    LineEvidence,
    condition_lines,
    decide,
    deviation_deg,
    half_sphere,
    line_scores,
    line_support,
    visible_from,
)
from reconstruction.tangents.point_lines import WIDEST_PIXEL, halves_of_lines
from reconstruction.tangents.pooling import Evidence, chosen, pool
from reconstruction.tangents.reflection import (
    FEWEST_LIGHTS,
    OlatStack,
    learned,
    observe,
    surface_normals,
)

CANDIDATES = 500  # directions that are scored at each point
MOST_SATURATED = 0.1
MOST_DEVIATION = 10.0
"""`Measured.deviation` above which most directions are more than 10° off."""
TRANSPARENT = 3.0  # tolerances between a point and the surface behind it
MOST_POINTS = 250_000
"""At most so many points have directions: their scores and responses take about 7 GB under 331
lights in 16 cameras, beside a sweep's points."""
ROUNDS = 2  # of the reflection table, filled from the directions of the round before
LIGHT_GROUPS = 24  # groups of neighbouring lights, each with a texture of its own


@dataclass(frozen=True, eq=False)
class Measured:
    """Lines at surface points: `points (N, 3)`, `directions (N, 3)`, `confidence (N,)`.

    Neighbours are about `apart` metres from one another; inf: unknown.
    """

    points: Array
    directions: Array
    confidence: Array
    apart: float = np.inf

    @classmethod
    def none(cls) -> Measured:
        """No line at all."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))

    @property
    def deviation(self) -> float:
        """Degrees: the median over the lines of `deviation_deg`; 0 without any."""
        return float(np.median(deviation_deg(self.confidence))) if len(self.confidence) else 0.0

    def where(self, keep: Bools | slice) -> Measured:
        """The lines where `keep (N,)`."""
        kept = self.points[keep], self.directions[keep], self.confidence[keep]
        return Measured(*kept, self.apart)


def light_groups(lights: list[Light], count: int) -> Ints:
    """Group number `(L,)` of each light: nearest of `count` seeds.

    Farthest-point seeds, then two rounds of k-means; no randomness. Without lights the group of one
    fully lit frame.
    """
    if not lights:
        return np.zeros(1, np.int64)
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


def read_olat(capture: Capture, camera: Camera, lights: Sequence[str]) -> OlatStack:
    """The frames of `camera` under each of `lights`; missing or saturated pixels are unknown.

    Without lights, its `lit_frame`.
    """
    if not lights:
        image, saturated = lit_frame(capture, camera.name)
        return OlatStack(camera, grey(image)[None], ~saturated[None])
    olat = np.zeros((len(lights), camera.height, camera.width), np.float32)
    known = np.zeros(olat.shape, bool)
    for i, name in enumerate(lights):
        if capture.has_light(name, camera.name):
            image, saturated = capture.light(name, camera.name)
            olat[i], known[i] = grey(image), ~saturated
    return OlatStack(camera, olat, known)


@dataclass
class Saturation:
    """Counts hair samples (pixels under each light) and the saturated ones."""

    observed_count: int = 0
    saturated_count: int = 0

    def add(self, stack: OlatStack, hair: Bools) -> None:
        """Count the samples of one camera on its `hair (H, W)`."""
        known = stack.known[stack.shot][:, hair]
        self.observed_count += known.size
        self.saturated_count += known.size - int(known.sum())

    def record(self, stage: Stage) -> None:
        """Record the share; warn above `MOST_SATURATED`."""
        share = self.saturated_count / max(self.observed_count, 1)
        stage.figures["saturated"] = share
        if share > MOST_SATURATED:
            stage.warn(
                f"{share:.0%} of the hair pixels are saturated and ignored: add a shorter exposure"
            )


def measure_tangents(
    masked: MaskedCapture,
    cloud: PointCloud,
    depths: Mapping[str, Array],
    scale: CaptureScale,
    options: MeasureOptions = MeasureOptions(),
    stage: Stage | None = None,
    progress: Progress = silent,
) -> Measured:
    """Directions at the triangulated points of the `cloud`, or without any, at the depths'.

    `depths[camera] (H, W)` of the hair pixels are metres along z. Raises `CaptureError` for a
    capture without OLAT, fully lit and pattern frames.
    """
    stage = stage or Stage("orientation")
    capture = masked.capture
    names = capture.olat_lights()
    if not names and not capture.without_single_lights():
        raise CaptureError(
            f"{capture.path}: no OLAT, lit or pattern frames, which the orientations come from"
        )
    lights = [capture.rig.light(n) for n in names]
    group = light_groups(lights, LIGHT_GROUPS)
    cameras = [c for c in masked.cameras if masked.masks[c.name].hair.any()]
    shown = [np.where(masked.masks[c.name].hair, depths[c.name], 0.0) for c in cameras]
    points = cloud.points
    if not len(points):
        lifted = [_lifted(*view) for view in zip(cameras, shown, strict=True)]
        points = np.concatenate(lifted) if lifted else points
    points, apart = at_most(
        MOST_POINTS if options.thin is None else len(points), points, scale.thin
    )
    if apart > scale.thin:
        stage.leave_out(
            f"directions {1e3 * scale.thin:.2g} mm apart, as the pixels resolve",
            f"more than {MOST_POINTS:,} points take more than 12 GB",
            f"memory; directions are {1e3 * apart:.2g} mm apart. Option: measure.thin",
        )
    points, visible = _visible(points, cameras, shown, scale.tolerance)
    if not len(points):
        raise CaptureError(f"{capture.path}: no surface point lies on a hair mask")
    reads = len(lights) >= FEWEST_LIGHTS
    normals = _normals(points, cameras, visible) if reads else None
    candidates = half_sphere(CANDIDATES)
    halves = np.zeros((2, len(points), CANDIDATES), np.float32)  # by every other camera
    evidences, observations, saturation = [], [], Saturation()
    for k, camera in enumerate(cameras):  # the frames of one camera at a time bound memory
        progress("texture", 0.6 * k / len(cameras))
        mask = masked.masks[camera.name].hair
        stack = read_olat(capture, camera, names)
        saturation.add(stack, mask)
        details = _details(stack, mask, group, options.texture_scale)
        support = line_support(responses(options.bank, details))
        evidences.append(LineEvidence.of(camera, support, points, visible[:, k]))
        halves[k % 2, evidences[-1].index] += line_scores(evidences[-1], candidates)
        if normals is not None:
            observations.append(observe(stack, lights, points, normals, visible[:, k]))
        del stack, support  # before the next camera's are read
    saturation.record(stage)
    stage.figures["lines"] = condition_lines(evidences, len(points)).figures()
    second = [camera.name for camera in cameras[1::2]]
    lines = None
    if options.line_weight != 0:
        lines = halves_of_lines(points, cloud, second, scale.pixel, candidates)
    if lines is None and len(cloud):
        stage.leave_out(
            "lines in which points lie",
            f"pixels of {1e3 * scale.pixel:.2g} mm are wider than {1e3 * WIDEST_PIXEL:.2g} mm"
            if options.line_weight != 0
            else "measure.line_weight is 0",
            "part of this stage; slopes towards the cameras are less certain",
        )
    given = (options.radius, options.reflection_weight, options.line_weight)
    evidence = Evidence(halves, lines=lines)
    found = chosen(points, apart, evidence, *given)
    stage.figures["texture_radius_mm"] = 1e3 * found.radius
    near = pool(points, found.radius, options.neighbours)
    tangents = decide(near @ found.total(evidence), candidates)
    if not reads:
        stage.leave_out(
            "directions from reflection",
            f"{len(lights)} lights are fewer than {FEWEST_LIGHTS}" if lights else NO_SINGLE_LIGHTS,
            "the second half of this stage; directions come from the rest",
        )
    else:
        progress("reflection", 0.6)
        texture_only = tangents
        for _ in range(ROUNDS):
            table = learned(observations, tangents)
            more = np.zeros_like(halves)
            for k, o in enumerate(observations):
                more[k % 2, o.index] += table.scores(o, points, candidates)
            evidence = Evidence(halves, more, lines)
            found = chosen(points, apart, evidence, *given, contrast=table.contrast)
            near = pool(points, found.radius, options.neighbours)
            tangents = decide(near @ found.total(evidence), candidates)
            del more, evidence
        stage.figures.update(radius_mm=1e3 * found.radius, reflection_weight=found.weight)
        turned = np.abs((tangents.directions * texture_only.directions).sum(axis=1)).clip(0, 1)
        stage.figures["lobe_contrast"] = table.contrast
        stage.figures["turned_by_reflection_deg"] = float(np.median(np.degrees(np.arccos(turned))))
        if table.contrast < 1.3:
            stage.warn(
                f"directions from reflection are unreliable: the highlight is {table.contrast:.2f} "
                "times its surroundings, under 1.3"
            )
    measured = Measured(points, tangents.directions, tangents.confidence, apart)
    if measured.deviation > MOST_DEVIATION:
        stage.warn(
            f"directions are uncertain by {measured.deviation:.0f}° in the median, over "
            f"{MOST_DEVIATION:g}°, and their errors are larger: strands follow the flow of the "
            "hair, not fibres; pixels that are finer on the hair show more"
        )
    stage.figures.update(
        points=len(points),
        apart_mm=1e3 * apart,
        line_weight=found.lines,
        deviation_deg=measured.deviation,
        cameras_per_point={
            str(k): int(n) for k, n in enumerate(np.bincount(visible.sum(axis=1))) if n
        },
        confidence={f"p{q}": float(np.percentile(tangents.confidence, q)) for q in (10, 50, 90)},
    )
    return measured


def _details(stack: OlatStack, mask: Bools, group: Ints, scale: float) -> Floats:
    """Textures `(G, H, W)` of the hair under each group of captured lights, at least one.

    The local mean has `scale` pixels.
    """
    groups = [(group == g) & stack.shot for g in np.unique(group)]
    known = [mask & stack.known[of].all(axis=0) for of in groups]
    shown = [(of, m) for of, m in zip(groups, known, strict=True) if of.any() and m.any()]
    if not shown:
        return np.zeros((1, *mask.shape), np.float32)
    return textures([stack.olat[of].sum(axis=0) for of, _ in shown], [m for _, m in shown], scale)


def _visible(
    points: Array, cameras: Sequence[Camera], depths: Sequence[Array], tolerance: float
) -> tuple[Array, Bools]:
    """Those of `points (N, 3)` that are visible in some camera, and in which, `(M, C)`.

    A camera whose depth lies more than `TRANSPARENT` tolerances behind a point sees through it: it
    shows something else there. Points that more cameras see through than see are dropped.
    """
    visible = np.zeros((len(points), len(cameras)), bool)
    through = np.zeros_like(visible)
    for k, (camera, depth) in enumerate(zip(cameras, depths, strict=True)):
        visible[:, k] = visible_from(camera, depth, points, tolerance)
        nearer = np.where(depth > 0, np.maximum(depth - TRANSPARENT * tolerance, 0.0), 0.0)
        through[:, k] = visible_from(camera, nearer, points, 0.0)
    visible &= ~through
    kept = visible.sum(axis=1) >= np.maximum(through.sum(axis=1), 1)
    return points[kept], visible[kept]


def _normals(points: Array, cameras: Sequence[Camera], visible: Bools) -> Array:
    """Surface normals `(N, 3)` towards the cameras in which points are `visible (N, C)`."""
    centers = np.stack([camera.center for camera in cameras])
    return surface_normals(points, visible @ centers - visible.sum(axis=1, keepdims=True) * points)


def _lifted(camera: Camera, depth: Array) -> Array:
    """World points `(P, 3)` of the positive pixels of a `depth (H, W)`."""
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


def at_most(count: int, points: Array, spacing: float) -> tuple[Array, float]:
    """`thinned` points `(M, 3)`, M <= `count`, and their spacing: at least `spacing` metres."""
    found = thinned(points, spacing)
    while len(found) > count:
        spacing *= max(1.05, (len(found) / count) ** 0.5)
        found = thinned(points, spacing)
    return found, spacing
