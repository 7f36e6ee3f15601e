"""What the depth search finds against what it costs, and the filter bank beside OpenCV's loop."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from reconstruction import Strands
from reconstruction.arrays import Array, Bools, Floats
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.images.orientation import filters, responses
from reconstruction.light_codes.code_views import View
from reconstruction.light_codes.depth_range import depth_range
from reconstruction.light_codes.search import LEAST_CONFIDENCE, DepthMap, DepthSearch
from reconstruction.light_codes.segments import to_segments
from reconstruction.reconstruct_options import LightCodeOptions, LogGaborBank, SearchOptions

VARIANTS: dict[str, dict[str, dict[str, Any]]] = {
    "depth step, mm": {str(1e3 * s): {"step": s} for s in (5e-4, 2.5e-4, 1.25e-4)},
    "neighbours": {str(n): {"neighbours": n} for n in (4, 8, 16, 23)},
    "candidates": {str(n): {"candidates": n} for n in (1, 4, 8, 24)}
    | {"all": {"candidates": 0, "lattice": 1}},
    "lattice": {str(n): {"lattice": n} for n in (1, 4, 8)},
}
"""What is varied from the defaults, one at a time."""

RIGHT = 1e-3, 10.0
"""Metres and degrees from a true strand within which a segment is right."""


def study_depths(
    views: Sequence[View],
    volume: VoxelGrid,
    truth: Strands,
    options: LightCodeOptions,
    which: Sequence[int],
) -> dict[str, dict[str, dict[str, float]]]:
    """For every variant: seconds, the share of right segments, and that of brute force's depths.

    Over the reference pixels of the views `which`. `right` is the share of the pixels whose segment
    is `RIGHT`; `as_brute_force` that whose depth lies within half a step of the one that trying all
    depths finds, kernels compiled before either is timed.
    """
    dense = truth.resampled(3e-4)
    tree = cKDTree(dense.points)
    tangents = dense.tangents()
    center = volume.centers().mean(axis=0)
    ranges = {k: depth_range(views[k].camera, volume) for k in which}

    def found(search: SearchOptions) -> tuple[list[DepthMap], float]:
        depths = DepthSearch(views, center, search)
        depths.run(which[0], *ranges[which[0]])
        begin = time.perf_counter()
        maps = [depths.run(k, *ranges[k]) for k in which]
        return maps, time.perf_counter() - begin

    wanted = sum(
        int((views[k].mask & (views[k].confidence >= LEAST_CONFIDENCE)).sum()) for k in which
    )
    brute, _ = found(replace(options.search, candidates=0, lattice=1))
    out: dict[str, dict[str, dict[str, float]]] = {}
    for name, variants in VARIANTS.items():
        for value, change in variants.items():
            maps, seconds = found(replace(options.search, **change))
            segments = to_segments([views[k] for k in which], maps)
            right = _right(segments.points, segments.directions, tree, tangents)
            same = sum(
                _same(a, b, options.search.step / 2) for a, b in zip(maps, brute, strict=True)
            )
            out.setdefault(name, {})[value] = {
                "seconds": seconds,
                "right": float(right.sum()) / wanted,
                "as_brute_force": same / sum(len(m.x) for m in brute),
            }
    return out


def _right(points: Array, along: Array, tree: cKDTree, tangents: Any) -> Bools:
    reach, turn = RIGHT
    _, index = tree.query(points, k=32, distance_upper_bound=reach, workers=-1)
    there = index < tree.n
    cosine = np.einsum("nki,ni->nk", tangents[np.where(there, index, 0)], along)
    return np.asarray((there & (np.abs(cosine) >= np.cos(np.radians(turn)))).any(axis=1))


def _same(a: DepthMap, b: DepthMap, within: float) -> int:
    """How many pixels have the same depth in both."""
    width = int(max(a.x.max(initial=0), b.x.max(initial=0))) + 1
    _, i, j = np.intersect1d(a.y * width + a.x, b.y * width + b.x, return_indices=True)
    return int((np.abs(a.depth[i] - b.depth[j]) <= within).sum())


def opencv_loop(bank: LogGaborBank, image: ArrayLike, margin: int) -> Floats:
    """`responses` of one image `(H, W)` by `cv2.filter2D`: two kernels for every filter.

    A kernel is a filter's transform on the padded image, cut to `margin` pixels around its middle.
    """
    pixels = np.asarray(image, np.float32)
    size = 2 * margin + 1
    out = np.empty((bank.count, *pixels.shape), np.float32)
    for k, transfer in enumerate(filters(bank, *(4 * size,) * 2)):
        kernel = np.roll(np.fft.ifft2(transfer), (margin, margin), axis=(0, 1))[:size, :size]
        kernel = kernel[::-1, ::-1]  # OpenCV correlates
        parts = [
            cv2.filter2D(
                pixels,
                cv2.CV_32F,
                np.ascontiguousarray(part, np.float32),
                borderType=cv2.BORDER_REFLECT_101,
            )
            for part in (kernel.real, kernel.imag)
        ]
        out[k] = np.hypot(*parts)
    return out


def compare_filters(bank: LogGaborBank, image: ArrayLike, margin: int = 48) -> dict[str, float]:
    """Seconds of our bank and of OpenCV's loop on an image, and how far their answers differ.

    `difference` is the root mean square one over that of the answers, `margin` pixels off the
    edges; times are the least of three.
    """
    pixels = np.asarray(image, np.float32)
    times: dict[str, float] = {}
    answers: dict[str, Floats] = {}

    def ours() -> Floats:
        return responses(bank, pixels)

    def opencv() -> Floats:
        return opencv_loop(bank, pixels, margin)

    for run in (ours, opencv):
        name = run.__name__
        times[name] = np.inf
        for _ in range(3):
            begin = time.perf_counter()
            answers[name] = run()
            times[name] = min(times[name], time.perf_counter() - begin)
    off = np.sqrt(((answers["ours"] - answers["opencv"]) ** 2).mean())
    size = np.sqrt((answers["opencv"] ** 2).mean())
    return {
        "ours_s": times["ours"],
        "opencv_s": times["opencv"],
        "faster": times["opencv"] / times["ours"],
        "difference": float(off / size),
    }
