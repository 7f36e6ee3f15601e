"""The parameters of an interpolation's guide, searched by leaving out frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from appearance.fields.interpolation import Interpolation, weighted
from appearance.fields.kajiya_kay import KajiyaKay
from reconstruction import Progress, Stage, silent
from reconstruction.arrays import AnyFloats, Array, Floats, Ints

DIFFUSE = tuple(float(x) for x in np.geomspace(0.02, 3, 8))
EXPONENT = tuple(float(x) for x in np.geomspace(2, 120, 12))
"""The grid of ρ_d and α."""
BLOCK = 8
"""Side of the blocks whose worst error counts, pixels."""


@dataclass(frozen=True, eq=False)
class Search:
    """The result: `errors (lights, 8, 12)` over `DIFFUSE` and `EXPONENT`, and `standard (lights,)`
    of standard interpolation: of the worst block, relative to the brightest of the left-out frame.
    """

    lights: tuple[str, ...]
    errors: Array
    standard: Array

    @property
    def best(self) -> KajiyaKay:
        """The model of least mean error over the left-out lights."""
        i, j = np.unravel_index(int(self.errors.mean(axis=0).argmin()), self.errors.shape[1:])
        return KajiyaKay(DIFFUSE[i], EXPONENT[j])

    def record(self, stage: Stage) -> None:
        """Record the parameters in `stage`, with their range over the lights, and warnings."""
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
                f"alpha of the Kajiya-Kay guide differs between left-out lights: "
                f"{min(exponent):.3g} to {max(exponent):.3g}"
            )
        if self.errors.mean(axis=0).min() >= self.standard.mean():
            stage.warn("standard interpolation is as good as with the Kajiya-Kay guide")


def searched(
    interpolation: Interpolation,
    lights: Sequence[str],
    *,
    cameras: int = 2,
    progress: Progress = silent,
) -> Search:
    """Grid search: each of `lights` is left out and interpolated from the others (Photobooth §4.2).

    The error is the greatest L2 over blocks of `BLOCK`² pixels, as highlights are small, in at most
    `cameras` views whose frame of the light is not black; lights without such a frame are skipped.
    Raises `ValueError` without lights to leave out.
    """
    if not lights or len(interpolation.field.lights) < len(lights) + 2:
        raise ValueError(f"a search needs lights to leave out and two more, got {list(lights)}")
    judging = {light: _judging(interpolation, light, cameras) for light in lights}
    lights = [light for light in lights if judging[light]]
    if not lights:
        raise ValueError(f"all frames of the left-out lights are black: {list(judging)}")
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
    """Numbers of at most `most` sources whose frame of a light is not black."""
    number = np.array([[x.name for x in interpolation.field.lights].index(light)])
    there = [
        k
        for k, source in enumerate(interpolation.sources)
        if np.nanmax(source.view.under(number), initial=0) > 0
    ]
    return sorted({there[int((i + 0.5) * len(there) / most)] for i in range(most) if there})


class _Judge:
    """`Relit.under` of a captured view under a left-out light, for many models at once: of a model
    B = S + ρ_d C, S and C are evaluated once per exponent."""

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
