# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Score strands with NumPy and SciPy alone
#
# Usage: `python score_alone.py PRED TRUE [--visibility FOLDER] [--samples N] [--seed N]`; prints
# JSON. Strands are polylines in metres, root first: `.npz` with `points (N, 3)` and `offsets
# (S + 1,)`, cyHair `.hair`, or `.obj` with lines `v x y z` and `l i j ...`.
#
# Both sets are resampled at 1 mm. A point matches if any point of the other set lies within the
# distance and has an undirected tangent within the angle. Precision is the share of predicted
# points that match, recall that of true points, F their harmonic mean. `visible`: points that the
# depth maps in FOLDER do not hide. `equal_length`: of random predicted strands with the true total
# length, since density buys recall. `strand_consistency`: the mean over true strands of the largest
# share that matches one predicted strand.
#
# 2 mm/20° to 4 mm/90° are the thresholds of HairGS (Pan et al., BMVC 2025, loss/metrics.py), which
# compares the vertices of both sets instead of points at 1 mm. 1 mm/10° to 3 mm/30°, sampling and
# equal length are those of `hairstage evaluate geometry`.

# %%
import argparse
import json
import struct
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

THRESHOLDS = ((1, 10), (2, 20), (3, 30), (4, 40), (4, 90))
STEP = 1e-3
NAMES = [f"{mm}mm_{deg}deg" for mm, deg in THRESHOLDS]


def read_strands(path):
    """Points (N, 3) in metres and offsets (S + 1,)."""
    path = Path(path)
    if path.suffix == ".npz":
        with np.load(path) as data:
            return data["points"].astype("f4"), data["offsets"].astype(np.int64)
    if path.suffix == ".hair":
        data = path.read_bytes()
        strands, count, arrays, segments = struct.unpack_from("<4x4I", data)
        counts = np.full(strands, segments) if not arrays & 1 else None
        if counts is None:
            counts = np.frombuffer(data, "<u2", strands, 128).astype(np.int64)
        first = 128 + 2 * strands * (arrays & 1)
        points = np.frombuffer(data, "<f4", 3 * count, first).reshape(-1, 3)
        return points, np.concatenate([[0], np.cumsum(counts + 1)]).astype(np.int64)
    if path.suffix == ".obj":
        rows = [line.split() for line in path.read_text().splitlines() if line]
        vertices = np.array([r[1:4] for r in rows if r[0] == "v"], "f4").reshape(-1, 3)
        lines = [np.array([int(i) for i in r[1:]]) for r in rows if r[0] == "l"]
        index = [np.where(line > 0, line - 1, line + len(vertices)) for line in lines]
        offsets = np.cumsum([0, *map(len, index)])
        return vertices[np.concatenate(index)] if index else vertices[:0], offsets
    raise SystemExit(f"{path}: expected .npz, .hair or .obj")


class Cloud:
    """Strands as points 1 mm apart with unit tangents, and the strand of each."""

    def __init__(self, points, offsets):
        counts = np.diff(offsets)
        if len(points) != offsets[-1] or (counts < 2).any() or not np.isfinite(points).all():
            raise SystemExit("strands need two finite points or more, and offsets up to the last")
        step = np.linalg.norm(points[1:].astype(float) - points[:-1], axis=1)
        starts = np.delete(np.arange(len(points)), offsets[1:] - 1)
        owner = np.repeat(np.arange(len(counts)), counts)
        self.lengths = np.bincount(owner[starts], step[starts], len(counts))
        if self.lengths.sum() > 3e5:
            raise SystemExit("over 300 km of strands: are they in metres?")
        arc = np.zeros(len(points))
        arc[starts + 1] = step[starts]
        arc = np.cumsum(arc)
        size = np.maximum(np.ceil(self.lengths / STEP).astype(np.int64), 1) + 1
        self.first = np.concatenate([[0], np.cumsum(size)])
        self.strand = np.repeat(np.arange(len(size)), size)
        k = np.arange(self.first[-1]) - self.first[self.strand]
        last = size[self.strand] - 1
        begin, end = offsets[:-1][self.strand], offsets[1:][self.strand] - 2
        along = arc[begin] + self.lengths[self.strand] * (k / last)
        left = np.clip(np.searchsorted(arc, along, side="right") - 1, begin, end)
        span = arc[left + 1] - arc[left]
        w = np.divide(along - arc[left], span, out=np.zeros_like(along), where=span > 0)
        w = np.where(k == last, 1.0, np.clip(w, 0, 1))[:, None]
        left = np.where(k == last, end, left)
        self.points = (points[left] * (1 - w) + points[left + 1] * w).astype("f4")
        index = np.arange(len(k))
        after, before = np.where(k == last, index, index + 1), np.where(k == 0, index, index - 1)
        chord = self.points[after].astype(float) - self.points[before]
        length = np.linalg.norm(chord, axis=1, keepdims=True)
        unit = np.divide(chord, length, out=np.zeros_like(chord), where=length > 0)
        self.tangents = unit.astype("f4")

    def draw(self, samples, rng, visible=None):
        """Indices of at most `samples` random points, or of visible ones."""
        chosen = np.arange(len(self.points))
        if visible is not None:
            if samples and 5 * samples < len(chosen):
                chosen = np.sort(rng.choice(len(chosen), 5 * samples, replace=False))
            chosen = chosen[visible(self.points[chosen])]
        if samples and len(chosen) > samples:
            chosen = np.sort(rng.choice(chosen, samples, replace=False))
        return chosen


# %%
def pairs(mine, chosen, other, tree):
    """By part: indices into `chosen` and of points of `other` near them, and which thresholds."""
    for part in np.array_split(np.arange(len(chosen)), len(chosen) // 10_000 + 1):
        near = cKDTree(mine.points[chosen[part]]).sparse_distance_matrix(
            tree, max(mm for mm, _ in THRESHOLDS) * 1e-3, output_type="ndarray"
        )
        i, j = part[near["i"]], near["j"]
        cosine = np.abs(np.einsum("nk,nk->n", mine.tangents[chosen[i]], other.tangents[j]))
        yield i, j, [(near["v"] <= mm * 1e-3) & (cosine > np.cos(np.radians(deg)))
                     for mm, deg in THRESHOLDS]  # fmt: skip


def matched(mine, chosen, other, tree, kept=None):
    """Which of the chosen points match (T, n), and which match a strand of `kept`."""
    found = np.zeros((2, len(THRESHOLDS), len(chosen)), bool)
    for i, j, hits in pairs(mine, chosen, other, tree):
        for t, hit in enumerate(hits):
            found[0, t, i[hit]] = True
            if kept is not None:
                found[1, t, i[hit & kept[other.strand[j]]]] = True
    return found


def figures(precision, recall):
    """Precision, recall and F at each threshold, from what matches (T, n)."""
    out = {}
    for name, p, r in zip(NAMES, precision, recall):  # noqa: B905
        p, r = (float(x.mean()) if len(x) else 0.0 for x in (p, r))
        out[name] = {"precision": p, "recall": r, "f": 2 * p * r / (p + r) if p + r else 0.0}
    return out


def strand_consistency(true, pred, tree, samples, seed):
    """HairGS's metric at each threshold; of 1,000 random true strands if points are sampled."""
    counts = np.diff(true.first)
    which = np.arange(len(counts))
    if samples:
        order = np.random.default_rng(seed).permutation(len(counts))[:1000]
        which = np.sort(order[: max(1, (np.cumsum(counts[order]) <= 60_000).sum())])
    chosen = np.flatnonzero(np.isin(true.strand, which))
    best = np.zeros((len(THRESHOLDS), len(counts)))
    seen = [[] for _ in THRESHOLDS]
    for i, j, hits in pairs(true, chosen, pred, tree):
        for t, hit in enumerate(hits):
            seen[t].append(np.unique(i[hit] * len(pred.lengths) + pred.strand[j[hit]]))
    for t, parts in enumerate(seen):
        point, other = np.divmod(np.concatenate(parts), len(pred.lengths))
        pair, on_it = np.unique(
            true.strand[chosen[point]] * len(pred.lengths) + other, return_counts=True
        )
        np.maximum.at(best[t], pair // len(pred.lengths), on_it)
    return dict(zip(NAMES, (best[:, which] / counts[which]).mean(axis=1).tolist()))  # noqa: B905


def depth_maps(folder):
    """The test of visibility from depth maps of the true strands and the head, one per camera."""
    maps = [dict(np.load(path)) for path in sorted(Path(folder).glob("*.npz"))]

    def visible(points):
        out = np.zeros(len(points), bool)
        for m in maps:
            x, y, z = np.ascontiguousarray(m["matrix"][:, :3]) @ points.T + m["matrix"][:, 3:]
            front = z > 1e-6
            x, y = (np.divide(a, z, out=np.full_like(a, -np.inf), where=front) for a in (x, y))
            (left, top), (right, bottom) = m["image"]
            ok = front & (x >= left) & (y >= top) & (x < right) & (y < bottom)
            height, width = m["depth"].shape
            on = np.flatnonzero(ok & (x >= 0) & (y >= 0) & (x < width) & (y < height))
            ok[on] = z[on] <= m["depth"][y[on].astype(int), x[on].astype(int)] + np.float32(1e-3)
            out |= ok
        return out

    return visible


def score(pred, true, visible=None, samples=40_000, seed=0):
    """All figures of two `Cloud`s, as a dictionary."""
    rng, out, whole = np.random.default_rng(seed), {}, float(true.lengths.sum())
    kept = np.ones(len(pred.lengths), bool)
    if pred.lengths.sum() > whole:
        order = np.random.default_rng(seed).permutation(len(kept))
        middle = np.cumsum(pred.lengths[order]) - pred.lengths[order] / 2
        kept[order[max(1, int(np.searchsorted(middle, whole))) :]] = False
    trees = [cKDTree(c.points) for c in (true, pred)]
    equal = {}
    for name, test in {"visible": visible, "all": None}.items():
        if name == "all" or test is not None:
            theirs = true.draw(samples, rng, test)
            mine = pred.draw(samples, rng, test)
            if not len(theirs):
                raise SystemExit("no true strand is visible: are both in one frame?")
            precision = matched(pred, mine, true, trees[0])[0]
            recall, recall_kept = matched(true, theirs, pred, trees[1], kept)
            out[name] = figures(precision, recall)
            equal[name] = figures(precision[:, kept[pred.strand[mine]]], recall_kept)
    out["equal_length"] = equal
    out["strand_consistency"] = strand_consistency(true, pred, trees[1], samples, seed)
    out["metres"] = {"pred": float(pred.lengths.sum()), "true": whole}
    return out


# %%
if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Score strands; see the head of this file.")
    parser.add_argument("pred")
    parser.add_argument("true")
    parser.add_argument("--visibility", help="folder of depth maps (truth/visibility of a set)")
    parser.add_argument("--samples", type=int, default=40_000, help="points per set; 0: all")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    pred, true = (Cloud(*read_strands(path)) for path in (args.pred, args.true))
    test = depth_maps(args.visibility) if args.visibility else None
    print(json.dumps(score(pred, true, test, args.samples, args.seed), indent=1))
