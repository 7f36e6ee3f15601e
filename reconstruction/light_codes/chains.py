"""Line segments strung together into polylines: ends that choose one another are joined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from reconstruction.strands import smoothed

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class ChainOptions:
    """`reach` metres from one line to the next, of which at most `aside` across it; `angle_deg`.

    Polylines shorter than `shortest` metres are left out; the others are `smooth`ed, metres.
    """

    reach: float = 1.5e-3
    aside: float = 3e-4
    angle_deg: float = 20.0
    neighbours: int = 16
    shortest: float = 2e-3
    smooth: float = 2e-3


def chains(points: Array, directions: Array, options: ChainOptions = ChainOptions()) -> list[Array]:
    """Polylines `(n, 3)` through lines at `points (N, 3)` along `directions (N, 3)`.

    Each line has two ends, ahead and behind. An end chooses the nearest line ahead of it that goes
    on in its direction; where two ends choose one another they are joined, so that a line has at
    most one follower at each end. Polylines shorter than `shortest` metres are left out.
    """
    if len(points) < 2:
        return []
    partner = _partners(points, directions, options)
    out = []
    done = np.zeros(len(points), bool)
    loose = np.flatnonzero((partner < 0).any(axis=1))
    for start in [*loose.tolist(), *range(len(points))]:  # whatever is left then runs in a ring
        if done[start]:
            continue
        path = _walk(partner, done, start)
        line = points[path]
        if (
            len(line) > 1
            and np.linalg.norm(np.diff(line, axis=0), axis=1).sum() >= options.shortest
        ):
            out.append(smoothed(line, options.smooth))
    return out


def _partners(points: Array, directions: Array, options: ChainOptions) -> Ints:
    """For both ends of each line `(N, 2)` the end it is joined with, 2·line + side, or -1."""
    count = min(options.neighbours, len(points))
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    distance, index = tree.query(
        points, k=np.arange(1, count + 1), distance_upper_bound=options.reach
    )
    there = np.isfinite(distance) & (index != np.arange(len(points))[:, None])
    index = np.where(there, index, 0)
    apart = points[index] - points[:, None]
    along = np.einsum("nki,ni->nk", apart, directions)
    cosine = np.einsum("nki,ni->nk", directions[index], directions)
    # how far either line misses the other's point
    own = np.sqrt(np.maximum((apart**2).sum(-1) - along**2, 0))
    back = np.einsum("nki,nki->nk", apart, directions[index])
    other = np.sqrt(np.maximum((apart**2).sum(-1) - back**2, 0))
    aside = np.maximum(own, other)
    there &= (np.abs(cosine) >= np.cos(np.radians(options.angle_deg))) & (aside <= options.aside)
    there &= np.abs(along) > aside
    chosen = np.full((len(points), 2), -1, np.int64)
    rows = np.arange(len(points))
    for side, sign in ((0, -1.0), (1, 1.0)):
        cost = np.where(there & (sign * along > 0), np.abs(along) + 2 * aside, np.inf)
        best = cost.argmin(axis=1)
        j = index[rows, best]
        # its end that looks back: the one behind where both lines run the same way
        same = cosine[rows, best] > 0
        end = 2 * j + np.where(same, 1 - side, side)
        chosen[:, side] = np.where(np.isfinite(cost[rows, best]), end, -1)
    flat = chosen.ravel()
    mutual = (flat >= 0) & (flat[np.maximum(flat, 0)] == np.arange(len(flat)))
    return np.where(mutual, flat, -1).reshape(-1, 2)


def _walk(partner: Ints, done: NDArray[np.bool_], start: int) -> list[int]:
    """The lines from `start` on, by the end that is joined, until an end that is not."""
    path = [start]
    done[start] = True
    side = 1 if partner[start, 1] >= 0 else 0
    end = int(partner[start, side])
    while end >= 0 and not done[end // 2]:
        node, came = divmod(end, 2)
        path.append(node)
        done[node] = True
        end = int(partner[node, 1 - came])
    return path
