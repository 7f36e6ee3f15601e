"""One roughness and one colour for all hair: the baseline that GroomLight calls HairInverse."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from appearance import HairAppearance, HairScene
from appearance.observations import Observed
from appearance.sun_fit.fit import BETA_N, SunFit
from appearance.sun_fit.fit_pixels import FitPixels
from appearance.sun_fit.options import FitOptions
from reconstruction import Progress, Stage, silent
from reconstruction.arrays import Array

GUESS = 0.3
"""Longitudinal roughness where the pictures show no highlight to read it from."""


def hair_inverse(
    scene: HairScene,
    hair: Sequence[Observed],
    skin: Sequence[Observed] = (),
    *,
    options: FitOptions | None = None,
    stage: Stage | None = None,
    progress: Progress = silent,
    seed: int = 0,
) -> tuple[HairAppearance, Array]:
    """One roughness and one colour for all hair, and the skin's albedo `(3,)` (Sun 2021, §5).

    Where too few samples lie near a mirror direction the roughness is `GUESS`, with a warning in
    `stage`.
    """
    options, stage = options or FitOptions(), stage or Stage("start")
    few = [_thinned(o, options.hair_pixels, seed) for o in hair]
    base = scene.with_hair(HairAppearance((0.1, 0.1, 0.1), GUESS, BETA_N))
    fitting = SunFit(base, FitPixels(few, skin), options, seed, progress)
    try:
        found = fitting.roughness(stage)
        beta_m = found.matched.beta_m
        start: Array | None = np.array(found.first.colour)
        albedo = np.array(found.first.skin)
    except ValueError as error:
        stage.warn(f"the roughness is a guess, {GUESS}: {error}")
        beta_m, start, albedo = GUESS, None, np.array(scene.skin)
    colours = fitting.colour(beta_m, start, albedo, stage)
    return colours.hair, np.array(colours.skin)


def _thinned(o: Observed, most: int, seed: int) -> Observed:
    if len(o.pixels) <= most:
        return o
    keep = np.zeros(len(o.pixels), bool)
    keep[np.random.default_rng(seed).permutation(len(o.pixels))[:most]] = True
    return o.where(keep)
