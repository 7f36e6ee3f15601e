"""Subjects of known appearance, captured by our own renderer, to judge a fit on.

(a) one colour on true strands; (b) a gradient from root to tip and dyed wisps on true strands;
(c) the frames of (b), to be fitted on strands bent by 5° RMS of tangent noise; (r) the frames of
(b), to be fitted on strands that a reconstruction made.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from appearance import Exposure, HairAppearance, HairScene, build_scene, render_olat
from appearance.bsdf.maps import HairMaps, MappedStrands, root_normals, scalp_coordinates
from appearance.bsdf.strand_coordinates import transported
from appearance.observations import Observed
from appearance.render.coverage import coverage
from appearance.render.olat import render_indirect, spread_out
from appearance.render.smoothed import SIGMA, smoothed
from benchmarks.subjects import Subject
from reconstruction import Camera, Light, Strands
from reconstruction.arrays import Array, Floats, Ints
from reconstruction.geometry.lights import dome_positions

SUBJECTS = ("a", "b", "c")
RECONSTRUCTED = "r"
TANGENT_NOISE_DEG = 5.0
JUDGED_VIEW = 3
"""A training view by which pictures are judged too, where frames are clean."""
_BEND = 0.1
"""Metres of a bend's wave along the strand."""


@dataclass(frozen=True)
class SmallStage:
    """A small stage: cameras on a ring, lights on a dome; every other one is held out.

    Frames have `spp` paths a pixel, renderings that are judged against them `judged_spp`. `truth`
    are the cells (n_c, w, h) of subject (b)'s dye. With `clean_spp` all of these have their
    indirect light smoothed over a pixel, and every fourth held-out light, in the held-out views and
    one training view, is rendered with so many paths: pictures are judged by these.
    """

    size: int = 64
    cameras: int = 6
    lights: int = 16
    fov_deg: float = 24.0
    spp: int = 384
    judged_spp: int = 384
    max_depth: int = 10
    truth: tuple[int, int, int] = (6, 24, 24)
    clean_spp: int = 0

    def halves(
        self,
        scene: HairScene,
        camera: Camera,
        lights: Sequence[Light],
        pixels: Ints,
        sampling: tuple[int, int],
    ) -> tuple[Floats, Floats]:
        """Two independent pictures `(L, P, 3)`; `sampling`: paths a pixel of both, and a seed."""
        spp, seed = sampling
        one, other = (
            self._picture(scene, camera, lights, pixels, (spp // 2, seed + h)) for h in (0, 1)
        )
        return one, other

    def _picture(
        self,
        scene: HairScene,
        camera: Camera,
        lights: Sequence[Light],
        pixels: Ints,
        sampling: tuple[int, int],
    ) -> Floats:
        spp, seed = sampling
        render_options: dict[str, Any] = {"spp": spp, "max_depth": self.max_depth, "seed": seed}
        if not self.clean_spp:
            return render_olat(scene, camera, lights, pixels=pixels, **render_options)
        rest = render_indirect(scene, camera, lights, pixels, **render_options)
        render_options |= {"spp": 2 * spp, "max_depth": 1, "seed": seed + (1 << 31)}
        direct = render_olat(scene, camera, lights, pixels=pixels, **render_options)
        share = np.zeros((camera.height, camera.width), np.float32)
        share.reshape(-1)[pixels] = 1
        shares = {"hair": share, "head": np.zeros_like(share)}
        smooth = smoothed(spread_out(rest, pixels, camera), shares, SIGMA)
        return np.asarray(direct + smooth.reshape(len(lights), -1, 3)[:, pixels])


@dataclass(frozen=True, eq=False)
class Captured:
    """Frames of a subject: `views` under all `lights`, and what is held out of a fit.

    `mapped` holds the strands to fit on; `truth` the maps behind the frames, on `true_mapped`.
    `halves` are two independent renderings of each view `(L, P, 3)`, whose means `views` hold.
    `judged` are the numbers of views and lights by which pictures are judged.
    """

    mapped: MappedStrands
    true_mapped: MappedStrands
    truth: HairMaps
    skin: Array
    views: tuple[Observed, ...]
    halves: tuple[tuple[Floats, Floats], ...]
    held_views: tuple[int, ...]
    held_lights: tuple[int, ...]
    exposure: Exposure
    rig: SmallStage
    judged: tuple[tuple[int, int], ...]

    @property
    def train_lights(self) -> tuple[int, ...]:
        """Indices of the lights that a fit sees."""
        return tuple(i for i in range(len(self.views[0].lights)) if i not in self.held_lights)

    def training(self, lights: Sequence[Light] | None = None) -> list[Observed]:
        """What a fit sees; with other descriptions of the lights where `lights` are given."""
        keep = list(self.train_lights)
        known = self.views[0].lights if lights is None else tuple(lights)
        return [
            replace(
                o,
                lights=tuple(known[i] for i in keep),
                radiance=o.radiance[keep],
                valid=o.valid[keep],
            )
            for i, o in enumerate(self.views)
            if i not in self.held_views
        ]


def known_subject(
    name: str, subject: Subject, rig: SmallStage, seed: int = 0, before: Captured | None = None
) -> Captured:
    """Subject `name` of `SUBJECTS`, its base colour and roughness those of `subject`.

    (c) has the frames of `before`, which is (b); None captures them.
    """
    if name not in SUBJECTS:
        raise ValueError(f"there is no subject {name!r}; there are {SUBJECTS}")
    if name == "c":
        return _on_bent(before or known_subject("b", subject, rig, seed), subject, seed)
    strands, head, hair = subject.strands, subject.head, subject.hair
    scene = subject.scene()
    mapped = MappedStrands.of(scene, strands, scalp_coordinates(strands, head))
    truth = HairMaps.of(hair) if name == "a" else dyed(hair, seed, rig.truth)
    shown = mapped.with_maps(truth)
    cameras, lights = ring(strands, rig), dome(rig)
    held_views = (0, len(cameras) // 2)
    held_lights = tuple(range(1, len(lights), 2))
    judged_lights = held_lights[1::4] if rig.clean_spp else held_lights
    views, halves = [], []
    for k, camera in enumerate(cameras):
        pixels = np.flatnonzero((coverage(shown, camera)["hair"] > 0.7).ravel())
        half = rig.halves(shown, camera, lights, pixels, (rig.spp, (seed << 8) + 7777 + 2 * k))
        if rig.clean_spp and k in (*held_views, JUDGED_VIEW):
            few = [lights[i] for i in judged_lights]
            sampling = (rig.clean_spp, (seed << 8) + 5555 + 2 * k)
            clean = rig.halves(shown, camera, few, pixels, sampling)
            for frames, better in zip(half, clean, strict=True):
                frames[list(judged_lights)] = better
        halves.append(half)
        valid = np.ones(half[0].shape[:2], bool)
        views.append(Observed(camera, tuple(lights), pixels, 0.5 * (half[0] + half[1]), valid))
    exposure = Exposure.of([o.radiance[::2] for i, o in enumerate(views) if i not in held_views])
    return Captured(
        mapped,
        mapped,
        truth,
        np.array(subject.skin),
        tuple(views),
        tuple(halves),
        held_views,
        held_lights,
        exposure,
        rig,
        tuple(
            (k, i)
            for k in range(len(cameras))
            if not rig.clean_spp or k in (*held_views, JUDGED_VIEW)
            for i in judged_lights
        ),
    )


def on_reconstructed(captured: Captured, strands: Strands, subject: Subject) -> Captured:
    """The frames of `captured`, to be fitted on `strands` that a reconstruction made of it."""
    scene = build_scene(strands, subject.head, hair=captured.truth.mean(), skin=captured.skin)
    uv = scalp_coordinates(strands, subject.head)
    return replace(captured, mapped=MappedStrands.of(scene, strands, uv))


def _on_bent(captured: Captured, subject: Subject, seed: int) -> Captured:
    """The frames of `captured`, to be fitted on bent strands."""
    uv = captured.mapped.root_uv
    noisy = bent(subject.strands, uv, TANGENT_NOISE_DEG, seed)
    scene = build_scene(noisy, subject.head, hair=captured.truth.mean(), skin=captured.skin)
    return replace(captured, mapped=MappedStrands.of(scene, noisy, uv))


def dyed(hair: HairAppearance, seed: int, shape: tuple[int, int, int] = (6, 24, 24)) -> HairMaps:
    """`hair`, bleached to a quarter of its absorption at the tips, with wisps dyed red and blue."""
    rng = np.random.default_rng(seed)
    maps = HairMaps.of(hair, shape)
    along = np.linspace(1.0, 0.25, shape[0])[:, None, None, None]
    sigma_a = maps.sigma_a * along
    u, v = np.meshgrid(*((np.arange(n) + 0.5) / n for n in shape[1:]), indexing="ij")
    dyes = np.array([[0.05, 1.2, 1.6], [1.4, 0.7, 0.1]])
    for k in range(10):
        middle, radius = rng.uniform(0.1, 0.9, 2), rng.uniform(0.06, 0.12)
        wisp = (u - middle[0]) ** 2 + (v - middle[1]) ** 2 < radius**2
        sigma_a[:, wisp] = dyes[k % 2]
    return replace(maps, sigma_a=sigma_a)


def bent(strands: Strands, uv: Array, rms_deg: float, seed: int) -> Strands:
    """`strands` offset along a wave, so that tangents turn by `rms_deg` RMS and roots stay.

    Direction and phase of the wave, in the strands' own frames, vary smoothly over the scalp:
    neighbours are wrong alike, as in reconstructions. About 2 mm of offset for 5°.
    """
    rng = np.random.default_rng([seed, 5])
    waves = rng.normal(size=(2, 4, 2)) * 3.0
    shift = rng.uniform(0, 2 * np.pi, (2, 4))
    phase, turn = (
        1.5 * np.sin(uv @ w.T + s).sum(axis=1) for w, s in zip(waves, shift, strict=True)
    )
    tangents = strands.tangents().astype(float)
    offsets = strands.offsets
    points = np.arange(len(tangents))
    normals = transported(tangents, np.diff(offsets), root_normals(strands))
    strand = strands.strand_of_point
    across = np.cos(turn)[strand, None] * normals
    across += np.sin(turn)[strand, None] * np.cross(tangents, normals)
    step = np.linalg.norm(np.diff(strands.points.astype(float), axis=0, prepend=0), axis=1)
    arc = np.cumsum(np.where(points == offsets[strand], 0, step))
    angle = 2 * np.pi * (arc - arc[offsets[strand]]) / _BEND
    wave = (np.sin(angle + phase[strand]) - np.sin(phase[strand]))[:, None] * across
    size = np.radians(rms_deg) * np.sqrt(2) * _BEND / (2 * np.pi)
    for _ in range(3):
        out = replace(strands, points=strands.points + size * wave)
        size *= np.radians(rms_deg) / _rms_angle(tangents, out.tangents().astype(float))
    return out


def _rms_angle(one: Array, other: Array) -> float:
    sine = np.linalg.norm(np.cross(one, other), axis=1)
    return float(np.sqrt((np.arctan2(sine, (one * other).sum(axis=1)) ** 2).mean()))


def ring(strands: Strands, rig: SmallStage) -> list[Camera]:
    low, high = strands.points.min(axis=0).astype(float), strands.points.max(axis=0).astype(float)
    middle = 0.5 * (low + high)
    reach = 0.5 * float(np.linalg.norm(high - low))
    distance = reach / np.sin(np.radians(rig.fov_deg / 2))
    out = []
    for k in range(rig.cameras):
        angle = 2 * np.pi * k / rig.cameras - np.pi / 2
        height = 0.25 if k % 2 else 0.05
        place = middle + distance * np.array([np.cos(angle), np.sin(angle), height])
        out.append(Camera.look_at(f"cam_{k}", rig.size, rig.size, place, middle, rig.fov_deg))
    return out


def dome(rig: SmallStage) -> list[Light]:
    places = dome_positions(rig.lights, 1.2, lowest_deg=-30)
    return [Light(f"light_{i:02d}", p, np.full(3, 8.0)) for i, p in enumerate(places)]
