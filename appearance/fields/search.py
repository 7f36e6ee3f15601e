"""What guides an interpolation, found in the frames: a model's parameters, and turned strands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from appearance.fields.interpolation import Interpolation, Source, irradiance, turned, weighted
from appearance.fields.kajiya_kay import KajiyaKay
from reconstruction import Light, Progress, Stage, silent
from reconstruction.arrays import AnyFloats, Array, Floats, Ints

DIFFUSE = tuple(float(x) for x in np.geomspace(0.02, 3, 8))
EXPONENT = tuple(float(x) for x in np.geomspace(2, 120, 12))
"""The grid of ρ_d and α."""
BLOCK = 8
"""Pixels of a side of the blocks whose worst error counts."""
CANDIDATES, WITHIN_DEG = 60, 15.0
_PIXELS = 4096
"""Pixels of a camera that are turned at a time."""
_LIGHTS = 48
"""Lights at most, evenly spread, whose samples decide about a turn."""


@dataclass(frozen=True, eq=False)
class Search:
    """What a search found: `errors (lights, 8, 12)` over `DIFFUSE` and `EXPONENT`.

    `standard (lights,)` is the error of standard interpolation. Errors are those of the worst
    block, in parts of the brightest block of the left-out picture.
    """

    lights: tuple[str, ...]
    errors: Array
    standard: Array

    @property
    def best(self) -> KajiyaKay:
        """The model of least mean error over the lights that were left out."""
        i, j = np.unravel_index(int(self.errors.mean(axis=0).argmin()), self.errors.shape[1:])
        return KajiyaKay(DIFFUSE[i], EXPONENT[j])

    def record(self, stage: Stage) -> None:
        """Record the parameters in `stage`, with their spread over the lights, and its warnings.

        Warned of are a best value at the end of the grid, a best model that standard interpolation
        beats, and lights that do not agree.
        """
        best = self.best
        each = [np.unravel_index(int(e.argmin()), e.shape) for e in self.errors]
        diffuse, exponent = [DIFFUSE[i] for i, _ in each], [EXPONENT[j] for _, j in each]
        stage.figures |= {
            "diffuse": best.diffuse,
            "exponent": best.exponent,
            "diffuse_range": [min(diffuse), max(diffuse)],
            "exponent_range": [min(exponent), max(exponent)],
            "worst_block": float(self.errors.mean(axis=0).min()),
            "worst_block_standard": float(self.standard.mean()),
            "left_out": list(self.lights),
        }
        for name, value, grid in (
            ("rho_d", best.diffuse, DIFFUSE),
            ("alpha", best.exponent, EXPONENT),
        ):
            if value in (grid[0], grid[-1]):
                stage.warn(f"{name} of the Kajiya-Kay guide is at the end of its grid, {value:.3g}")
        if max(exponent) > 4 * min(exponent):
            stage.warn(
                f"lights left out do not agree on alpha of the Kajiya-Kay guide: "
                f"{min(exponent):.3g} to {max(exponent):.3g}"
            )
        if self.errors.mean(axis=0).min() >= self.standard.mean():
            stage.warn("standard interpolation is as good as with a Kajiya-Kay guide")


def searched(
    interpolation: Interpolation,
    lights: Sequence[str],
    *,
    cameras: int = 2,
    progress: Progress = silent,
) -> Search:
    """Try all of the grid: each of `lights` is left out and made of the others (Photobooth §4.2).

    The error is the greatest L2 over blocks of `BLOCK`² pixels: highlights cover few. In at most
    `cameras` views, spread over those whose frame of the light shows something; a light without
    such a frame is not left out. Raises `ValueError` without lights to leave out.
    """
    if not lights or len(interpolation.field.lights) < len(lights) + 2:
        raise ValueError(f"a search leaves lights out and needs others, got {list(lights)}")
    judging = {light: _judging(interpolation, light, cameras) for light in lights}
    lights = [light for light in lights if judging[light]]
    if not lights:
        raise ValueError(f"a search needs frames of the lights it leaves out, {list(judging)}")
    rest = interpolation.without(lights=lights)
    errors = np.zeros((len(lights), len(DIFFUSE), len(EXPONENT)))
    standard = np.zeros(len(lights))
    for i, light in enumerate(lights):
        used = judging[light]
        for k, number in enumerate(used):
            judge = _Judge(interpolation, rest, number, light)
            standard[i] += judge.standard() / len(used)
            for j, exponent in enumerate(EXPONENT):
                done = (i + (k + j / len(EXPONENT)) / len(used)) / len(lights)
                progress("searching the guide's parameters", done)
                errors[i, :, j] += np.array(judge.errors(exponent)) / len(used)
    return Search(tuple(lights), errors, standard)


def _judging(interpolation: Interpolation, light: str, most: int) -> list[int]:
    """At most so many of the sources in which a light shows something, by their numbers."""
    number = np.array([[x.name for x in interpolation.field.lights].index(light)])
    there = [
        k
        for k, source in enumerate(interpolation.sources)
        if np.nanmax(source.view.under(number), initial=0) > 0
    ]
    return sorted({there[int((i + 0.5) * len(there) / most)] for i in range(most) if there})


class _Judge:
    """A captured view under a light that is left out of an interpolation.

    What `Relit.under` makes of it, for many models at once: of a model B = S + ρ_d C the parts
    S and C are found once for each exponent.
    """

    def __init__(self, full: Interpolation, rest: Interpolation, number: int, light: str) -> None:
        names = [x.name for x in full.field.lights]
        new = full.field.lights[names.index(light)]
        source, kept = full.sources[number], rest.sources[number]
        order, weights = rest.neighbours([new])
        near = [rest.field.lights[j] for j in order[0]]
        self.samples, self.weights = kept.view.under(order[0]), weights[0]
        self.truth = source.view.under(np.array([names.index(light)]))[0]
        self.blocks = blocks(source.view.pixels, source.view.camera.width)
        self.lights, self.source, self.floor = [*near, new], source, rest.floor
        self.every = np.arange(len(source.view.pixels))
        self.light_alone = source.guided(None, self.lights, self.every)

    def errors(self, exponent: float) -> list[float]:
        """The worst block's error for all of `DIFFUSE`."""
        specular, both = (
            self.source.guided(KajiyaKay(d, exponent), self.lights, self.every) for d in (0.0, 1.0)
        )
        out = []
        for d in DIFFUSE:
            epsilon = np.float32(self.floor * KajiyaKay(d, exponent).mean)
            guided = specular + np.float32(d) * (both - specular) + epsilon * self.light_alone
            out.append(self._error(guided))
        return out

    def standard(self) -> float:
        """The worst block's error of standard interpolation."""
        return self._error(self.light_alone)

    def _error(self, guided: Floats) -> float:
        unknown = np.full_like(self.samples, np.nan)
        near = np.divide(self.samples, guided[:-1], out=unknown, where=guided[:-1] > 0)
        made = weighted(near, self.weights) * guided[-1]
        good = (np.isfinite(self.truth) & np.isfinite(made)).all(axis=-1)[:, None]
        worst = worst_block(np.where(good, np.maximum(made, 0) - self.truth, 0), self.blocks)
        brightest = worst_block(np.where(good, self.truth, 0), self.blocks)
        return worst / brightest if brightest > 0 else 0.0


def blocks(pixels: Ints, width: int) -> Ints:
    """Which block of `BLOCK`² pixels each of the flat `pixels (P,)` is in, counted from 0."""
    row, column = np.divmod(pixels, width)
    across = -(-width // BLOCK)
    return np.unique(row // BLOCK * across + column // BLOCK, return_inverse=True)[1]


def worst_block(values: AnyFloats, block: Ints) -> float:
    """The greatest root of summed squares of `values (P, 3)` over blocks `(P,)`."""
    return float(np.sqrt(np.bincount(block, (values.astype(float) ** 2).sum(axis=1)).max()))


def refined(interpolation: Interpolation, progress: Progress = silent) -> Interpolation:
    """Every camera's strands turned to what its samples agree with best (Photobooth §4.2).

    Each pixel is tried with its tangents turned towards `CANDIDATES` directions within
    `WITHIN_DEG`: the turn counts whose model is most like the samples over irradiance, of `_LIGHTS`
    lights, by the cosine of the angle between the two as vectors, over the samples that are known.
    Raises `ValueError` without a model.
    """
    if interpolation.model is None:
        raise ValueError("turning strands needs a model to compare with the samples")
    sources = []
    for k, source in enumerate(interpolation.sources):
        turn = source.turn.copy()
        for start in range(0, len(turn), _PIXELS):
            share = (k + start / len(turn)) / len(interpolation.sources)
            progress(f"turning strands for {source.view.camera.name}", share)
            part = np.arange(start, min(start + _PIXELS, len(turn)))
            turn[part] = _best_turns(source, interpolation.model, interpolation.field.lights, part)
        sources.append(replace(source, turn=turn))
    return replace(interpolation, sources=tuple(sources))


def _best_turns(source: Source, model: KajiyaKay, lights: Sequence[Light], pixels: Ints) -> Floats:
    """Axis-angles `(Q, 3)` for the pixels of numbers `pixels (Q,)`."""
    few = np.unique(np.linspace(0, len(lights) - 1, _LIGHTS).astype(np.int64))
    hits = source.hits
    weight = hits.table["weight"][pixels]
    outer = hits.table["tangent"][pixels]
    spread = np.einsum("qk,qki,qkj->qij", weight, outer, outer)
    tangent = np.linalg.eigh(spread)[1][..., -1].astype(np.float32)
    point = hits.middle()[pixels]
    away = source.view.camera.center - point
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    toward = np.stack([lights[k].position for k in few])[:, None] - point
    toward /= np.linalg.norm(toward, axis=-1, keepdims=True)
    sample = source.view.table[few][:, pixels].astype(np.float32).mean(axis=-1)
    given = np.stack([irradiance(lights[k], point).mean(axis=-1) for k in few])
    known = np.isfinite(sample) & (given > 0)
    sample = np.divide(sample, given, out=np.zeros_like(sample), where=known)
    found, best = np.zeros((len(pixels), 3), np.float32), np.full(len(pixels), -np.inf)
    for turn in _candidates(tangent):
        guide = model(turned(turn, tangent), away.astype(np.float32), toward.astype(np.float32))
        guide = np.where(known, guide, 0)
        like = (sample * guide).sum(axis=0) / np.maximum(np.linalg.norm(guide, axis=0), 1e-12)
        better = like > best
        found[better], best[better] = turn[better], like[better]
    return found


def _candidates(tangent: Floats) -> list[Floats]:
    """Turns `(Q, 3)` of unit `tangent (Q, 3)` towards directions even over the cap, 0 first."""
    least = np.eye(3, dtype=np.float32)[np.abs(tangent).argmin(axis=1)]
    one = np.cross(tangent, least)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    other = np.cross(tangent, one)
    k = np.arange(CANDIDATES + 1)
    angle = np.radians(WITHIN_DEG) * np.sqrt(k / CANDIDATES)
    about = k * np.pi * (3 - np.sqrt(5))
    return [
        np.asarray(a * (np.cos(b) * one + np.sin(b) * other), np.float32)
        for a, b in zip(angle, about, strict=True)
    ]
