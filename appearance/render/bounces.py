"""Measures how many bounces are needed: few in dark hair, many in blond."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance.render.coverage import covered_pixels
from appearance.render.paths import Surface
from appearance.render.tracing import PathLimits, PathPlan, Paths, add_light, follow
from appearance.scene.hair_scene import HairScene
from appearance.scene.opaque import opaque_index
from reconstruction import Camera
from reconstruction.arrays import Array, Ints

_LONGEST = 256
_STREAM = 1 << 29
_ROULETTE = 0.02  # long paths are what is looked for: they are ended late


@dataclass(frozen=True)
class BounceLimit:
    """A limit on the vertices of a path, and what it leaves out.

    `left_out` is the measured share of the light beyond `depth`, `bound` its upper end (three
    standard errors), each in the channel that loses most.
    """

    depth: int
    left_out: float
    bound: float


def bounce_limit(
    scene: HairScene,
    camera: Camera,
    share: float = 2e-3,
    *,
    pixels: Ints | None = None,
    paths: int = 4096,
    seed: int = 0,
) -> BounceLimit:
    """The smallest depth that leaves out at most `share` of the light.

    Measured under uniform light, where a path's contribution is its throughput when it leaves the
    subject. A light that reaches a pixel only by many bounces may lose a larger share. `pixels
    (P,)` default to those of the subject; about `paths` paths are traced. The largest depth is 256.
    Raises `ValueError` for `share` outside (0, 1).
    """
    if not 0 < share < 1:
        raise ValueError(f"share must be between 0 and 1, got {share}")
    index = covered_pixels(scene, camera) if pixels is None else pixels
    if not len(index):
        return BounceLimit(1, 0.0, 0.0)
    index = index[:: -(-len(index) // paths)]
    by_depth = _by_depth(scene, camera, index, -(-paths // len(index)), seed)
    beyond = by_depth[::-1].cumsum(0)[::-1]  # (depths, P, 3), and more
    whole = beyond[0].mean(0)
    reached = whole > 0
    if not reached.any():
        return BounceLimit(1, 0.0, 0.0)
    lost = beyond[1:, :, reached]
    left_out = lost.mean(1) / whole[reached]
    # the ratio's error to first order: of beyond - ratio x whole over the pixels
    error = (lost - left_out[:, None] * beyond[0][:, reached]).std(1) / whole[reached]
    bound = (left_out + 3 * error / np.sqrt(len(index))).max(-1)
    depth = int(np.argmax(bound <= share))  # nothing is left beyond the last one
    return BounceLimit(depth + 1, float(left_out[depth].max()), float(bound[depth]))


def _by_depth(scene: HairScene, camera: Camera, index: Ints, spp: int, seed: int) -> Array:
    """Light of a white sky by the number of the path's vertices from 1, `(256 + 1, P, 3)`."""
    film = dr.zeros(mi.Float, (_LONGEST + 1) * 3 * len(index))
    slots = opaque_index(len(index))

    def escape(ray: Any, paths: Paths) -> None:
        left = paths.active & (paths.depth > 0)
        first = (paths.depth - 1) * 3 * slots + paths.slot
        add_light(film, paths.throughput, first, left, slots)

    # one ray more than vertices: the light of the last vertex is the ray that leaves it
    plan = PathPlan(spp, (seed, _STREAM), PathLimits(_LONGEST + 1, _ROULETTE))
    follow(Surface(scene), camera, index, plan, lambda si, paths: None, escape)
    return np.array(film, np.float64).reshape(_LONGEST + 1, 3, len(index)).transpose(0, 2, 1) / spp
