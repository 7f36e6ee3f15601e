"""A fine groom from a coarse one: children around each guide strand, in a ball of space only.

A head has some 100,000 fibres of 40 µm radius, a strand file about a tenth as many. A patch that
cameras resolve needs the fibres; the rest of the head keeps the file's strands at their coverage.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from appearance.bsdf.strand_coordinates import transported
from reconstruction import Strands
from reconstruction.arrays import Array, Bools, Ints
from simulators.subject.grooms import covering_radius

FIBRES = 100_000
RADIUS = 40e-6

_STEP = 1e-3  # metres between a child's points
_WAVES = np.array([4e-3, 11e-3, 29e-3])  # wavelengths of a child's own deviations, metres


@dataclass(frozen=True)
class FineGroom:
    """How children lie about their guide.

    `spread`: the disk of roots they fill, in medians of the distance from a guide's root to the
    nearest other. At the tip the disk is narrower by the share `clumping`. `deviation`: of each
    child's own waves, metres; the share `fly_aways` of the children has five times as much.
    """

    spread: float = 1.0
    clumping: float = 0.5
    deviation: float = 1.5e-4
    fly_aways: float = 0.03


def fine_groom(
    guides: Strands,
    center: tuple[float, float, float],
    radius: float,
    groom: FineGroom = FineGroom(),
    seed: int = 0,
) -> Strands:
    """`FIBRES / len(guides)` children of `RADIUS` for each guide where it passes the ball.

    Elsewhere the guides themselves, of the radius that keeps the coverage of `FIBRES`. The ball has
    its `center` and `radius` in metres. Points have radii of their own. Same seed, same bytes.

    Raises `ValueError` where no guide passes the ball.
    """
    dense = _splined(guides)
    inside = np.linalg.norm(dense.points - np.asarray(center), axis=1) < radius
    if not inside.any():
        raise ValueError(f"no strand passes the ball of {radius:g} m about {center}")
    rest = _pieces(dense, ~inside, covering_radius(len(guides)))
    owner = np.unique(dense.strand_of_point[inside])
    own = np.zeros(len(dense), bool)
    own[owner] = True
    fine = _children(dense.subset(own), guides, groom, np.random.default_rng(seed))
    near = np.linalg.norm(fine.points - np.asarray(center), axis=1) < radius
    parts = [_pieces(fine, near, RADIUS), rest]
    offsets = np.concatenate([parts[0].offsets, parts[0].offsets[-1] + parts[1].offsets[1:]])
    return Strands(
        np.concatenate([p.points for p in parts]),
        offsets,
        np.concatenate([np.full(len(p.points), p.radius, np.float32) for p in parts]),
    )


def _splined(guides: Strands) -> Strands:
    """Points `_STEP` apart on the cubic splines through the guides' points: coarse ones turn by
    30 degrees at a point, which no camera shows at a pixel of half a millimetre."""
    out = []
    for i in range(len(guides)):
        p = guides[i].astype(float)
        arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1)))
        keep = np.append(True, np.diff(arc) > 0)
        if keep.sum() > 1:
            at = np.linspace(0, arc[-1], max(2, int(np.ceil(arc[-1] / _STEP)) + 1))
            out.append(CubicSpline(arc[keep], p[keep])(at))
    return Strands.from_list(out, RADIUS)


def _children(
    dense: Strands, guides: Strands, groom: FineGroom, rng: np.random.Generator
) -> Strands:
    """All children of the `dense` guides, whole."""
    roots = guides.points[guides.offsets[:-1]]
    apart = float(np.median(cKDTree(roots).query(roots, k=2)[0][:, 1])) if len(roots) > 1 else 0.0
    each = max(1, round(FIBRES / len(guides)))
    counts = np.diff(dense.offsets)
    tangents = dense.tangents().astype(float)
    across = transported(tangents, counts, np.tile([1.0, 0.0, 0.0], (len(counts), 1)))
    third = np.cross(tangents, across)
    first = np.repeat(dense.offsets[:-1], counts)
    step = np.arange(len(dense.points)) - first
    arc = np.asarray(step * _STEP, np.float64)
    share = step / np.repeat(np.maximum(counts - 1, 1), counts)
    paths = []
    for _ in range(each):
        angle, out = rng.uniform(0, 2 * np.pi, len(counts)), np.sqrt(rng.uniform(0, 1, len(counts)))
        out *= groom.spread * apart
        narrow = np.repeat(out, counts) * (1 - groom.clumping * share)
        wide = np.where(rng.uniform(size=len(counts)) < groom.fly_aways, 5.0, 1.0)
        own = groom.deviation * np.repeat(wide, counts)[:, None] * _waves(arc, counts, rng)
        turn = np.repeat(angle, counts)
        own[:, 0] += narrow * np.cos(turn)
        own[:, 1] += narrow * np.sin(turn)
        paths.append(dense.points + own[:, :1] * across + own[:, 1:] * third)
    points = np.concatenate(paths).astype(np.float32)
    ends = np.concatenate([dense.offsets[1:] + k * len(dense.points) for k in range(each)])
    return Strands(points, np.concatenate([[0], ends]), RADIUS)


def _waves(arc: Array, counts: Ints, rng: np.random.Generator) -> Array:
    """Offsets `(N, 2)` along strands at `arc (N,)` metres, of deviation 1."""
    phase = rng.uniform(0, 2 * np.pi, (len(counts), 2, len(_WAVES)))
    length = _WAVES * rng.uniform(0.8, 1.25, (len(counts), 2, len(_WAVES)))
    # amplitudes in proportion to the wavelength: each bends as much as the others
    size = _WAVES / np.sqrt(0.5 * (_WAVES**2).sum())
    at = 2 * np.pi * arc[:, None, None] / np.repeat(length, counts, axis=0)
    return np.asarray((size * np.sin(at + np.repeat(phase, counts, axis=0))).sum(axis=2))


def _pieces(strands: Strands, keep: Bools, radius: float) -> Strands:
    """The runs of at least two kept points, each a strand."""
    owner = strands.strand_of_point
    starts = keep & ~np.r_[False, keep[:-1] & (owner[1:] == owner[:-1])]
    piece = (np.cumsum(starts) - 1)[keep]
    count = np.bincount(piece) if len(piece) else np.zeros(0, np.int64)
    long = count >= 2
    offsets = np.concatenate([[0], np.cumsum(count[long])]).astype(np.int64)
    return Strands(strands.points[keep][np.repeat(long, count)], offsets, radius)
