"""Frames that fields are judged on: the truth beside what inverse rendering would make of it.

A groom with a truth finer than the fit, and inverse rendering emulated: strands bent by 5°, coarse
colours, β_M 7 % and β_N 10 % off. Under environments, lights of the dome stand for the map about
them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from appearance import Exposure, build_scene
from appearance.bsdf.maps import MappedStrands, scalp_coordinates
from appearance.fields.anchors import Places
from appearance.fields.hits import HitOptions, find_hits
from appearance.fields.pictures import Pictures
from appearance.metrics.scores import srgb
from appearance.render.coverage import coverage
from appearance.render.environment_maps import environment_map
from appearance.render.olat import render_indirect, render_olat
from appearance.render.smoothed import smoothed
from benchmarks.appearance.known_subjects import SmallStage, bent, dome, dyed, ring
from benchmarks.subjects import Subject
from reconstruction import Light, Strands
from reconstruction.arrays import AnyFloats, Array, Floats

COARSE = (4, 8, 8)
"""Cells of the emulated inverse rendering's colours."""
DIRECT = 2
"""Times as many paths for the light of the first hit, which no smoothing frees of noise. What other
light has is the same all over a small picture, so that it needs nearly as many."""
HELD_VIEWS = (0.0, 0.5)
"""How far round the ring the cameras are that no fit sees."""
GROUPS = ("new lights", "new views", "both new")
MAPS = ("studio", "sky")
MAPPED = "maps"
Pair = tuple[AnyFloats, AnyFloats]


@dataclass(frozen=True, eq=False)
class Frames:
    """A subject: `halves` of the truth's and of inverse rendering's pictures, views by number.

    Each is two independent pictures `(L, P, 3)`; `pictures` have the means, under all lights.
    `mapped` holds the bent `strands`.
    """

    pictures: tuple[Pictures, ...]
    true: tuple[tuple[Floats, Floats], ...]
    rendered: tuple[tuple[Floats, Floats], ...]
    places: Places
    scale: float
    held_views: tuple[int, ...]
    held_lights: tuple[int, ...]
    mapped: MappedStrands
    strands: Strands

    def training(self) -> list[Pictures]:
        """What a fit sees."""
        lights = len(self.pictures[0].lights)
        kept = [i for i in range(lights) if i not in self.held_lights]
        return [p.under(kept) for k, p in enumerate(self.pictures) if k not in self.held_views]

    def errors(self, pictures: Mapping[int, Pair]) -> tuple[Array, Array]:
        """Errors of displayed values without noise, and how many: by view, light and group `(V, L,
        G)`, 0 where a picture is of another group or not given.

        Errors are sums of products of those of independent halves.
        """
        lights = len(self.pictures[0].lights)
        sums, counts = np.zeros((2, len(self.pictures), lights, len(GROUPS)))
        new = np.isin(np.arange(lights), self.held_lights)
        for k, (one, other) in pictures.items():
            a, b = (
                srgb(x * self.scale) - srgb(t * self.scale)
                for x, t in zip((one, other), self.true[k], strict=True)
            )
            held = k in self.held_views
            for group, of in ((2 if held else 0, new), *([(1, ~new)] if held else [])):
                sums[k, of, group] = (a * b)[of].sum(axis=(1, 2))
                counts[k, of, group] = a[0].size
        return sums, counts

    def psnr(self, pictures: Mapping[int, Pair]) -> dict[str, float]:
        """PSNR without noise by group of `GROUPS`; under `MAPPED`, that of held-out views under
        environments, where all of them are given.
        """
        sums, counts = (x.sum(axis=(0, 1)) for x in self.errors(pictures))
        out = {
            name: float(-10 * np.log10(max(sums[g] / counts[g], 1e-6)))
            for g, name in enumerate(GROUPS)
            if counts[g]
        }
        if set(self.held_views) <= set(pictures):
            out[MAPPED] = under_maps(self, lambda k, weights: summed(pictures[k], weights))
        return out

    def gains(self, pictures: Mapping[int, Pair]) -> dict[str, dict[str, float]]:
        """By group, how much better than inverse rendering's, in dB, and the standard error.

        That is from leaving out one view or light in turn: what other views and lights might say.
        """
        made, _ = self.errors(pictures)
        without, _ = self.errors(dict(enumerate(self.rendered)))
        gain = _decibels(made.sum(axis=(0, 1)), without.sum(axis=(0, 1)))
        found = {}
        for g, name in enumerate(GROUPS):
            # views and lights of other groups are none that could be left out
            rows, columns = (without[..., g].any(axis=k) for k in (1, 0))
            a, b = (x[rows][:, columns, g] for x in (made, without))
            found[name] = {"gain": float(gain[g]), "spread": _spread(a, b)}
        return found


def _decibels(squares: Array, without: Array) -> Array:
    """Gain in dB of sums of squares over those `without`, of any one shape."""
    ratio = np.maximum(without, 1e-30) / np.maximum(squares, 1e-30)
    return np.asarray(10 * np.log10(np.clip(ratio, 1e-10, 1e10)))


def _spread(squares: Array, without: Array) -> float:
    """Standard error of the gain over `without`, both by views and lights `(V, L)`.

    Jackknife variances over views and over lights add up. Infinite for one view and one light.
    """
    total = np.inf if max(without.shape) < 2 else 0.0
    for others in (0, 1):
        a, b = squares.sum(others), without.sum(others)
        if len(a) > 1:
            total += (len(a) - 1) * float(np.var(_decibels(a.sum() - a, b.sum() - b)))
    return float(np.sqrt(total))


def frames_of(subject: Subject, rig: SmallStage, seed: int) -> Frames:
    """The wavy groom dyed finely, captured; and as inverse rendering would have it."""
    strands, head = subject.strands, subject.head
    uv = scalp_coordinates(strands, head)
    scene = subject.scene()
    truth = dyed(subject.hair, seed, rig.truth)
    shown = MappedStrands.of(scene, strands, uv).with_maps(truth)
    noisy = bent(strands, uv, 5.0, seed)
    base = build_scene(noisy, head, hair=subject.hair, skin=subject.skin)
    mapped = MappedStrands.of(base, noisy, uv)
    coarse = truth.resized(COARSE)
    coarse = replace(coarse, beta_m=1.07 * truth.beta_m, beta_n=1.1 * truth.beta_n)
    fitted = mapped.with_maps(coarse)
    lights = tuple(dome(rig))
    cameras = ring(strands, rig)
    held = tuple(int(share * len(cameras)) for share in HELD_VIEWS)
    pictures, true, rendered = [], [], []
    for k, camera in enumerate(cameras):
        pixels = np.flatnonzero((coverage(shown, camera, 32)["hair"] > 0.7).ravel())
        halves = []
        for where, stream in ((shown, 0), (fitted, 1)):
            share = coverage(where, camera, 32)
            two = []
            for half in (0, 1):
                number = (seed << 10) + 100 * stream + 2 * k + half
                every = np.arange(camera.width * camera.height)
                rest = render_indirect(
                    where,
                    camera,
                    lights,
                    every,
                    spp=rig.spp // 2,
                    max_depth=rig.max_depth,
                    seed=number,
                )
                first = render_olat(
                    where,
                    camera,
                    lights,
                    pixels=pixels,
                    spp=DIRECT * rig.spp // 2,
                    max_depth=1,
                    thrift=0,
                    seed=number + 50,
                )
                size = (len(lights), camera.height, camera.width, 3)
                smooth = smoothed(rest.reshape(size), share, 1.5).reshape(len(lights), -1, 3)
                two.append(first + smooth[:, pixels])
            halves.append((two[0], two[1]))
        true.append(halves[0])
        rendered.append(halves[1])
        hits = find_hits(mapped, camera, pixels, HitOptions(16, seed))
        captured = np.float32(0.5) * (halves[0][0] + halves[0][1])
        valid = np.ones(captured.shape[:2], bool)
        pictures.append(Pictures(hits, lights, np.stack(halves[1]), captured, valid))
    held_lights = tuple(range(1, len(lights), 3))
    kept = [i for i in range(len(lights)) if i not in held_lights]
    observed = [p.captured[kept] for k, p in enumerate(pictures) if k not in held]
    scale = Exposure.of(x.reshape(-1, 3) for x in observed).scale
    return Frames(
        tuple(pictures),
        tuple(true),
        tuple(rendered),
        Places.of(uv),
        scale,
        held,
        held_lights,
        mapped,
        noisy,
    )


def under_maps(frames: Frames, made: Callable[[int, Array], Pair]) -> float:
    """PSNR without noise of held-out views under `MAPS`, each exposed by its truth's mean.

    `made(view, weights)` is a view's pair of pictures `(P, 3)` under all lights times weights.
    """
    products = []
    for name in MAPS:
        weights = map_weights(name, frames.pictures[0].lights)
        for k in frames.held_views:
            true = summed(frames.true[k], weights)
            scale = 0.3 / float(np.mean(true))
            pairs = zip(made(k, weights), true, strict=True)
            a, b = (srgb(x * scale) - srgb(t * scale) for x, t in pairs)
            products.append((a * b).ravel())
    return float(-10 * np.log10(max(float(np.concatenate(products).mean()), 1e-6)))


def summed(pair: Pair, weights: Array) -> Pair:
    """Two pictures `(P, 3)` of two stacks `(L, P, 3)`."""
    one, other = (np.tensordot(weights, x, 1) for x in pair)
    return one, other


def map_weights(name: str, lights: Sequence[Light]) -> Array:
    """Of each of the lights, the part of a map that is nearer to it than to others `(L,)`."""
    envmap = environment_map(name).astype(float).mean(axis=2)
    height, width = envmap.shape
    z = np.cos(np.pi * (np.arange(height) + 0.5) / height)
    angle = (0.5 - (np.arange(width) + 0.5) / width) * 2 * np.pi
    flat = np.sqrt(1 - z**2)[:, None]
    texels = np.stack(
        np.broadcast_arrays(flat * np.cos(angle), flat * np.sin(angle), z[:, None]), axis=-1
    )
    towards = np.array([x.position / np.linalg.norm(x.position) for x in lights])
    nearest = (texels @ towards.T).argmax(axis=-1)
    sums = np.bincount(nearest.ravel(), (envmap * flat).ravel(), len(lights))
    return np.asarray(sums, float)
