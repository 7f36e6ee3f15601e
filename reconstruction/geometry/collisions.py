"""Strands inside a head: counted, pushed out or cut."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import ndimage

from reconstruction.arrays import Array, Bools, Floats, Ints
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_distance import MeshDistance
from reconstruction.geometry.strands import Strands, smoothed, unit_or_zero

Collide = Literal["count", "push", "cut"]

SKIN = 1e-4
"""Metres below a surface that still count as on it: a fibre is 0.08 mm wide."""
STEP = 1e-3
"""Metres between points near the head: on a skull, a chord of twice that sinks by 7 µm."""
_CLEAR = SKIN / 2  # metres above the skin to which points are pushed
_NEAR = 1.5 * STEP  # to a target that a path has reached
_INERTIA = 0.2  # share of the last step's direction: a path does not turn back on flat skin
_SMOOTH = 2e-3  # metres along the strand over which a detour's ends are rounded


@dataclass(frozen=True)
class Inside:
    """The `strands` with points deeper than `SKIN`, of `of`, and the `metres` of them inside.

    `deepest` and `mean` are depths in metres.
    """

    strands: int
    of: int
    metres: float
    deepest: float
    mean: float

    def figures(self) -> dict[str, float]:
        """The figures for a report."""
        return {
            "strands": self.strands,
            "metres": self.metres,
            "deepest_mm": 1e3 * self.deepest,
            "mean_depth_mm": 1e3 * self.mean,
        }

    def __str__(self) -> str:
        return (
            f"{self.strands} of {self.of} strands pass through the head: {self.metres:.3g} m, up "
            f"to {1e3 * self.deepest:.2f} mm deep, {1e3 * self.mean:.2f} mm on average"
        )


class Collisions:
    """The parts of `strands` inside the mesh `head`.

    Raises `ValueError` for a head without an inside, see `MeshDistance`.
    """

    def __init__(self, strands: Strands, head: Mesh) -> None:
        self.strands, self.distance = strands, MeshDistance(head)
        height = self.distance(strands.points)[0]
        starts = strands.segment_starts
        step = np.linalg.norm(
            strands.points[starts + 1].astype(float) - strands.points[starts], axis=1
        )
        near = np.minimum(height[starts], height[starts + 1]) < step / 2  # may reach the skin
        index = np.unique(strands.strand_of_point[starts[near]])
        for _ in range(2):  # near the skin, then all points of the strands that are inside
            chosen = np.isin(strands.strand_of_point[starts], index)
            parts = np.maximum(np.ceil(step / STEP), 1).astype(np.int64)
            fine, own = _subdivided(strands.subset(index), np.where(near, parts, 1)[chosen])
            between = np.ones(len(fine.points), bool)
            between[own] = False
            fine_height = np.empty(len(between))
            fine_height[own] = height[np.isin(strands.strand_of_point, index)]
            fine_height[between] = self.distance(fine.points[between])[0]
            index = index[np.unique(fine.strand_of_point[fine_height < -SKIN])]
            near = np.ones(len(starts), bool)
        self.index = index
        """The strands that pass through the head."""
        self._fine, self._height = fine, fine_height

    @property
    def inside(self) -> Inside:
        """How much is inside."""
        fine, height = self._fine, self._height
        starts = fine.segment_starts
        step = np.linalg.norm(fine.points[starts + 1].astype(float) - fine.points[starts], axis=1)
        depth = np.stack([np.maximum(-height[starts + k], 0) for k in (0, 1)])
        above = np.stack([np.maximum(height[starts + k], 0) for k in (0, 1)])
        total = depth.sum(axis=0) + above.sum(axis=0)
        share = np.divide(depth.sum(axis=0), total, out=np.zeros_like(total), where=total > 0)
        metres = float(share @ step)
        mean = float((share * step) @ (depth.sum(axis=0) / np.maximum((depth > 0).sum(axis=0), 1)))
        return Inside(
            len(fine),
            len(self.strands),
            metres,
            float(np.max(-height, initial=0)),
            mean / metres if metres else 0.0,
        )

    def resolved(self, how: Collide) -> tuple[Strands, Ints]:
        """The strands after `how`, and the index of the given strand that each one is of.

        "push" moves parts inside along the skin, with the strand's own length from the root; hair
        behind such a part slides along its curve. A root inside moves to the skin, others stay. A
        strand without such a way of its own length and without kinks, as in an ear, stays as it is.
        "cut" drops the parts inside: each part outside of at least `STEP` metres becomes a strand
        that begins at its root or where it leaves the skin.
        """
        every = np.arange(len(self.strands))
        if how == "count" or not len(self.index):
            return self.strands, every
        fine, others = self._fine, np.setdiff1d(every, self.index)
        lines = _lines(fine)
        heights = np.split(self._height, fine.offsets[1:-1])
        if how == "cut":
            cut = [_outside(line, h) for line, h in zip(lines, heights, strict=True)]
            new, owner = (
                [part for parts in cut for part in parts],
                np.repeat(self.index, [*map(len, cut)]),
            )
        else:
            new, owner = self._pushed(lines, heights), self.index
        both, ids = [*_lines(self.strands.subset(others)), *new], np.concatenate([others, owner])
        order = np.argsort(ids, kind="stable")
        lines = [both[k] for k in order]
        values = np.concatenate([*lines, np.zeros((0, 5))])
        offsets = np.cumsum([0, *map(len, lines)])
        return _of_values(values, offsets, self.strands), ids[order]

    def _pushed(self, lines: list[Array], heights: list[Array]) -> list[Array]:
        """`lines (n, C)` out of the head, their further columns unchanged."""
        runs = [(k, a, b) for k, h in enumerate(heights) for a, b in _runs(h < 0, h < -SKIN)]
        starts, targets = [], []
        for k, a, b in runs:
            points = lines[k][:, :3]
            height, out = self.distance(points[a:b])
            there = points[a:b] + (_CLEAR - height)[:, None] * out
            starts.append(points[a - 1] if a else there[0])
            targets.append(np.concatenate([there, points[b : b + 1]]))
        ways: list[list[tuple[int, int, Array]]] = [[] for _ in lines]
        for (k, a, b), way in zip(runs, self._along_skin(np.array(starts), targets), strict=True):
            ways[k].append((a, b, way))
        rough = [_rejoined(line[:, :3], of) for line, of in zip(lines, ways, strict=True)]
        soft = np.concatenate(smoothed([path for path, _ in rough], _SMOOTH))
        share = np.concatenate([weight for _, weight in rough])[:, None]
        path = (1 - share) * np.concatenate([path for path, _ in rough]) + share * soft
        for _ in range(2):
            height, out = self.distance(path)
            path = path + np.maximum(_CLEAR - height, 0)[:, None] * out * (share > 0)
        ends = np.cumsum([len(path) for path, _ in rough])[:-1]
        pushed = []
        for line, way, moved in zip(
            lines, np.split(path, ends), np.split(share > 0, ends), strict=True
        ):
            new = np.concatenate([_slid(line[:, :3], way, moved), line[:, 3:]], axis=1)
            outside = (self.distance(new[:, :3])[0] >= -SKIN).all()
            pushed.append(new if outside and _alike(line[:, :3], new[:, :3]) else line)
        return pushed

    def _along_skin(self, start: Array, targets: list[Array]) -> list[Array]:
        """Paths `(n, 3)` in steps of `STEP` from `start (R, 3)` past the `targets (m, 3)` of each,
        outside of the head."""
        last = np.array([len(t) - 1 for t in targets])
        table = np.zeros((len(targets), last.max() + 1, 3))
        for row, points in zip(table, targets, strict=True):
            row[: len(points)] = points
        at, x = np.zeros(len(table), np.int64), start
        before, (height, out) = np.zeros_like(x), self.distance(x)
        ways, going = [[p] for p in start], np.arange(len(table))
        for _ in range(2 * table.shape[1] + 50):  # half of a sphere's circumference is π/2 chords
            to = table[going, at] - x
            while (passed := (np.linalg.norm(to, axis=1) < _NEAR) & (at < last[going])).any():
                at = at + passed
                to = table[going, at] - x
            along = unit_or_zero(to)
            down = np.minimum((along * out).sum(axis=1), 0) * (height < STEP)
            along = along - down[:, None] * out + _INERTIA * before
            lost = np.linalg.norm(along, axis=1) < 1e-3  # the target is straight below
            along[lost] = np.cross(out, [1.0, 0.7, 0.4])[lost]
            moved = x + STEP * unit_or_zero(along)
            for _ in range(3):
                height, out = self.distance(moved)
                rise = np.where(down < 0, _CLEAR - height, np.maximum(_CLEAR - height, 0))
                moved = moved + rise[:, None] * out
                moved = x + STEP * unit_or_zero(moved - x)
            on = np.linalg.norm(to, axis=1) >= _NEAR
            for i, point in zip(going, np.where(on[:, None], moved, x + to), strict=True):
                ways[i].append(point)
            before = unit_or_zero(moved - x)
            going, at, x, before = going[on], at[on], moved[on], before[on]
            height, out = height[on], out[on]
            if not len(going):
                break
        return [np.array(way) for way in ways]


def _rejoined(line: Array, detours: list[tuple[int, int, Array]]) -> tuple[Array, Array]:
    """The path of `line (n, 3)` with its points a to b replaced by each detour `(a, b, way)`.

    Points `STEP` apart, and their shares of smoothing: 1 in a detour, 0 from three deviations on.
    """
    pieces, marks, first = [], [], 0
    for a, b, way in detours:
        pieces += [line[first : max(a - 1, 0)], way]
        marks += [np.zeros(len(pieces[-2])), np.ones(len(way))]
        first = b + 1
    pieces.append(line[first:])
    path, mark = np.concatenate(pieces), np.concatenate([*marks, np.zeros(len(pieces[-1]))])
    arc = _arc(path)
    even = np.linspace(0, arc[-1], int(np.ceil(arc[-1] / STEP)) + 2)
    away = ndimage.distance_transform_edt(np.interp(even, arc, mark) == 0) * STEP
    return _at(path, arc, even), np.clip(1 - away / (3 * _SMOOTH), 0, 1)


def _slid(line: Array, path: Array, moved: Bools) -> Array:
    """`line (n, 3)` on the `path (m, 3)` at its own arc lengths; exact before `path` has `moved`.

    A path that is too short continues straight.
    """
    own, arc = _arc(line), _arc(path)
    before = arc[int(moved.argmax())]
    end = path[-1] + unit_or_zero(path[-1:] - path[-2:-1])[0] * max(own[-1] - arc[-1], 0)
    path, arc = np.concatenate([path, [end]]), np.append(arc, max(own[-1], arc[-1]))
    return np.where((own < before)[:, None], line, _at(path, arc, own))


def _alike(line: Array, new: Array) -> bool:
    """Whether `new (n, 3)` is as long as `line (n, 3)` to 1 %, with no sharper turn above 60°."""
    (long, sharp), (as_long, as_sharp) = (
        (_arc(x)[-1], (d[1:] * d[:-1]).sum(axis=1).min(initial=1.0))
        for x in (line, new)
        for d in [unit_or_zero(np.diff(x, axis=0))]
    )
    return bool(abs(as_long - long) <= 0.01 * long and as_sharp >= min(sharp, 0.5))


def _outside(line: Array, height: Array) -> list[Array]:
    """The parts of `line (n, C)` above the skin, which begin and end on it."""

    def crossing(outer: int, inner: int) -> Array:
        if not 0 <= inner < len(line):
            return line[:0]
        above = max(height[outer], 0.0)
        share = above / (above - height[inner])
        return (line[outer] + share * (line[inner] - line[outer]))[None]

    parts = [
        np.concatenate([crossing(a, a - 1), line[a:b], crossing(b - 1, b)])
        for a, b in _runs(height >= -SKIN)
    ]
    return [part for part in parts if _arc(part[:, :3])[-1] >= STEP]


def _runs(which: Bools, having: Bools | None = None) -> list[tuple[int, int]]:
    """Begin and end of each run of `which (n,)`, of those with one of `having (n,)`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], which.astype(np.int8), [0]])))
    pairs = [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
    return [(a, b) for a, b in pairs if having is None or having[a:b].any()]


def _arc(line: Array) -> Array:
    """Arc length at each of `line (n, 3)`."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1)))


def _at(line: Array, arc: Array, where: Array) -> Array:
    """`line (n, 3)` at arc lengths `where (m,)`."""
    return np.stack([np.interp(where, arc, column) for column in line.T], axis=1)


def _subdivided(strands: Strands, parts: Ints) -> tuple[Strands, Ints]:
    """The strands with their segments `(N - S,)` in equal `parts`; further values interpolated.

    Also the indices `(N,)` of the given points among the new.
    """
    repeats = np.ones(len(strands.points), np.int64)
    repeats[strands.segment_starts] = parts
    left = np.repeat(np.arange(len(repeats)), repeats)
    first = np.cumsum(repeats) - repeats
    share = ((np.arange(len(left)) - first[left]) / repeats[left])[:, None]
    values = _values(strands)
    values = values[left] * (1 - share) + values[np.minimum(left + 1, len(values) - 1)] * share
    return _of_values(values, np.append(first, len(left))[strands.offsets], strands), first


def _values(strands: Strands) -> Array:
    """Position, radius and confidence `(N, 5)` of the points."""
    rest = (strands.radius, 1.0 if strands.confidence is None else strands.confidence)
    rows = [np.broadcast_to(x, len(strands.points)) for x in rest]
    return np.column_stack([strands.points, *rows]).astype(np.float64)


def _lines(strands: Strands) -> list[Array]:
    """`_values` by strand."""
    return np.split(_values(strands), strands.offsets[1:-1]) if len(strands) else []


def _of_values(values: Array, offsets: Ints, like: Strands) -> Strands:
    """Strands of `_values (N, 5)`, without what `like` does not have."""
    columns: Floats = values.astype(np.float32)
    radius = columns[:, 3] if isinstance(like.radius, np.ndarray) else like.radius
    confidence = None if like.confidence is None else columns[:, 4].clip(0, 1)
    return Strands(columns[:, :3], offsets, radius, confidence)
