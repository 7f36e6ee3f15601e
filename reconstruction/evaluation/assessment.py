"""Everything there is to say of strands beside the true ones; `hairstage evaluate geometry`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import Array
from reconstruction.evaluation.baselines import with_true_directions
from reconstruction.evaluation.connectivity import spread
from reconstruction.evaluation.matching import StrandComparison, compare_strands
from reconstruction.evaluation.oriented_points import Block, Drawn
from reconstruction.evaluation.visibility import Visibility
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.closest_point import ClosestPoint
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.strands import Strands
from reconstruction.growth.hair_envelope import pixel_size
from reconstruction.report.report import Progress, silent

ROOTED = 5e-3  # metres: a strand that ends this near the scalp reaches it
OTHER_UNITS = 10.0  # sizes that differ by this factor are hardly those of one head


class Nearest:
    """The nearest point of the other set to each of the `drawn (N,)` points.

    `distance (N,)` in metres, `cosine (N,)` between the tangents; infinite and 0 before `look`.
    """

    def __init__(self, drawn: Drawn) -> None:
        count = len(drawn.points)
        self.drawn = drawn
        self.distance = np.full(count, np.inf)
        self.cosine = np.zeros(count)

    def look(self, block: Block) -> None:
        """Keep the points of `block` that are nearer than those so far."""
        distance, j = block.tree.query(self.drawn.points, workers=-1)
        closer = np.flatnonzero(distance < self.distance)
        j = j[closer]
        self.distance[closer] = distance[closer]
        self.cosine[closer] = (self.drawn.tangents[closer] * block.tangents[j]).sum(axis=1)

    @property
    def angle_deg(self) -> Array:
        """Between the tangents as lines, 0 to 90 `(N,)`."""
        return np.degrees(np.arccos(np.minimum(np.abs(self.cosine), 1.0)))

    def figures(self) -> dict[str, Any]:
        """Spread of distance and angle; the share whose nearest point runs the other way."""
        return {
            "distance_mm": spread(1e3 * self.distance),
            "angle_deg": spread(self.angle_deg),
            "reversed": float((self.cosine < 0).mean()),
        }


@dataclass(frozen=True, eq=False)
class Assessment:
    """`figures` are JSON-ready; the rest is what pictures are made of."""

    figures: dict[str, Any]
    pred: Nearest
    true: Nearest


def assess_strands(
    pred: Strands,
    true: Strands,
    *,
    cameras: Sequence[Camera] | None = None,
    head: Mesh | None = None,
    seed: int = 0,
    samples: int | None = 40_000,
    progress: Progress = silent,
) -> Assessment:
    """Score predicted strands against the true ones, in every way this project knows.

    The figures are those of `compare_strands` and, beside them,

    - `errors.{pred,true}`: distance and angle between each point and the nearest of the other set
      (mean and percentiles), and the share whose nearest point runs the other way;
    - `roots.{pred,true}`: the share of strands whose root is within 5 mm of the scalp (`rooted`)
      and of those whose tip is and the root is not (`upside_down`). The scalp is what the head
      marks as such, or else the true roots (`roots.scalp` says which);
    - `true_directions`, where `cameras` are given: what `true_direction_figures` returns;
    - `warnings`: sentences about what looks wrong with the input.

    Raises as `compare_strands` does.
    """
    progress("what the cameras see", 0.0)
    visibility = Visibility(cameras, true, head) if cameras is not None and len(true) else None
    comparison = StrandComparison(pred, true, seed=seed, samples=samples, visibility=visibility)
    of_pred, of_true = (Nearest(matches.drawn) for matches in comparison.all)
    progress("predicted points among the true ones", 0.1)
    comparison.look_at_truth(of_pred)
    progress("true points among the predicted ones", 0.3)
    comparison.look_at_prediction(of_true)
    warnings = input_warnings(pred, true)
    figures = comparison.figures()
    if cameras is not None:
        progress("with the true directions over a pixel", 0.7)
        figures["true_directions"] = true_direction_figures(
            pred, true, cameras, visibility=visibility, seed=seed, samples=samples
        )
    figures |= {
        "errors": {"pred": of_pred.figures(), "true": of_true.figures()} if len(pred) else {},
        "roots": root_figures(pred, true, head),
        "warnings": warnings,
    }
    progress("judged", 1.0)
    return Assessment(figures, of_pred, of_true)


def true_direction_figures(
    pred: Strands,
    true: Strands,
    cameras: Sequence[Camera],
    *,
    visibility: Visibility | None = None,
    seed: int = 0,
    samples: int | None = 40_000,
) -> dict[str, Any]:
    """What `pred` would score with the true directions over a pixel (`with_true_directions`).

    A pixel is as wide as at the middle of the true strands, the median over `cameras`. Returns the
    `visible`, `all` and `equal_length` of `compare_strands`, and raises as it does: that pieces are
    many and lie on no one strand says nothing.
    """
    pixel = pixel_size(cameras, true.points.mean(axis=0, dtype=float))
    turned = with_true_directions(pred, true, pixel)
    found = compare_strands(turned, true, visibility=visibility, seed=seed, samples=samples)
    return {key: found[key] for key in ("visible", "all", "equal_length") if key in found}


def input_warnings(pred: Strands, true: Strands) -> list[str]:
    """What looks wrong with two sets of strands that should be of one head."""
    if not len(pred):
        return ["there are no predicted strands: precision is given as 0"]
    out = []
    boxes = [np.percentile(s.points, (1, 99), axis=0) for s in (pred, true)]
    mine, theirs = (float(np.linalg.norm(high - low)) for low, high in boxes)
    if max(mine, theirs) > OTHER_UNITS * min(mine, theirs):
        out.append(
            f"the predicted strands span {mine:.3g} m and the true ones {theirs:.3g} m: are both "
            "in metres?"
        )
    elif _y_up(pred, true):
        out.append(
            "the predicted strands would lie where the true ones do, were they turned from y up to "
            "z up, (x, -z, y): are both z up?"
        )
    elif (boxes[0][0] > boxes[1][1]).any() or (boxes[1][0] > boxes[0][1]).any():
        out.append("the predicted strands lie beside the true ones: are both in one frame?")
    still = int((pred.lengths() == 0).sum())
    if still:
        out.append(f"{still} of {len(pred)} predicted strands have no length, and so no direction")
    return out


def _y_up(pred: Strands, true: Strands) -> bool:
    """Whether `pred`, turned from y up to z up, lies at most half as far from `true`."""
    mine, theirs = (s.points[:: max(len(s.points) // 5000, 1)] for s in (pred, true))
    turned = mine[:, (0, 2, 1)] * np.array((1, -1, 1), np.float32)
    as_it_is, then = (
        sum(float(cKDTree(a).query(b)[0].mean()) for a, b in ((points, theirs), (theirs, points)))
        for points in (mine, turned)
    )
    return then < 0.5 * as_it_is


def root_figures(pred: Strands, true: Strands, head: Mesh | None = None) -> dict[str, Any]:
    """Which strands reach the scalp, as `assess_strands` says."""
    marked = head is not None and head.scalp is not None and bool(head.scalp.any())
    out: dict[str, Any] = {"scalp": "marked" if marked else "true roots"}
    if head is not None and marked:
        closest = ClosestPoint(head, 5e-3, head.scalp)
    else:
        tree = cKDTree(true.roots)
    for name, strands in (("pred", pred), ("true", true)):
        if not len(strands):
            continue
        ends = (strands.roots, strands.points[strands.offsets[1:] - 1])
        distance = [closest(e)[2] if marked else tree.query(e)[0] for e in ends]
        root, tip = (d <= ROOTED for d in distance)
        out[name] = {"rooted": float(root.mean()), "upside_down": float((tip & ~root).mean())}
    return out
