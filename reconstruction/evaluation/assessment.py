"""All scores of strands against the true ones; `hairstage evaluate geometry`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import Array
from reconstruction.capture_scale import pixel_size
from reconstruction.evaluation.baselines import with_true_directions
from reconstruction.evaluation.connectivity import spread
from reconstruction.evaluation.matching import StrandComparison, compare_strands
from reconstruction.evaluation.oriented_points import Block, Drawn
from reconstruction.evaluation.visibility import Visibility
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.closest_point import ClosestPoint
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.strands import Strands
from reconstruction.report.report import Progress, silent

ROOTED = 5e-3  # metres: largest distance of a rooted strand from the scalp
OTHER_UNITS = 10.0  # ratio of sizes that suggests different units


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
        """Update with the points of `block`."""
        distance, j = block.tree.query(self.drawn.points, workers=-1)
        closer = np.flatnonzero(distance < self.distance)
        j = j[closer]
        self.distance[closer] = distance[closer]
        self.cosine[closer] = (self.drawn.tangents[closer] * block.tangents[j]).sum(axis=1)

    @property
    def angle_deg(self) -> Array:
        """Angle `(N,)` between the undirected tangents, 0 to 90."""
        return np.degrees(np.arccos(np.minimum(np.abs(self.cosine), 1.0)))

    def figures(self) -> dict[str, Any]:
        """Spread of distance and angle; share of nearest points with the opposite direction."""
        return {
            "distance_mm": spread(1e3 * self.distance),
            "angle_deg": spread(self.angle_deg),
            "reversed": float((self.cosine < 0).mean()),
        }


@dataclass(frozen=True, eq=False)
class Assessment:
    """`figures` are JSON-ready; `pred` and `true` are for images."""

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
    """Score predicted strands against the true ones.

    The figures are those of `compare_strands` and

    - `errors.{pred,true}`: distance and angle between each point and the nearest of the other set
      (mean and percentiles), and the share whose nearest point has the opposite direction;
    - `roots.{pred,true}`: the share of strands with their root within 5 mm of the scalp (`rooted`)
      and with their tip there instead (`upside_down`). `roots.scalp` is "marked" by the head or
      "true roots";
    - `true_directions`, with `cameras`: see `true_direction_figures`;
    - `warnings`: sentences on suspicious input.

    Raises as `compare_strands` does.
    """
    progress("visibility", 0.0)
    visibility = Visibility(cameras, true, head) if cameras is not None and len(true) else None
    comparison = StrandComparison(pred, true, seed=seed, samples=samples, visibility=visibility)
    of_pred, of_true = (Nearest(matches.drawn) for matches in comparison.all)
    progress("matching predicted points", 0.1)
    comparison.match_predicted(of_pred)
    progress("matching true points", 0.3)
    comparison.match_true(of_true)
    warnings = input_warnings(pred, true)
    figures = comparison.figures()
    if cameras is not None:
        progress("true directions", 0.7)
        figures["true_directions"] = true_direction_figures(
            pred, true, cameras, visibility=visibility, seed=seed, samples=samples
        )
    figures |= {
        "errors": {"pred": of_pred.figures(), "true": of_true.figures()} if len(pred) else {},
        "roots": root_figures(pred, true, head),
        "warnings": warnings,
    }
    progress("evaluated", 1.0)
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
    """Scores of `pred` with the true directions over a pixel (`with_true_directions`).

    The pixel width is the median over `cameras` at the middle of the true strands. Returns the
    `visible`, `all` and `equal_length` of `compare_strands` and raises as it does.
    """
    pixel = pixel_size(cameras, true.points.mean(axis=0, dtype=float))
    turned = with_true_directions(pred, true, pixel)
    found = compare_strands(turned, true, visibility=visibility, seed=seed, samples=samples)
    return {key: found[key] for key in ("visible", "all", "equal_length") if key in found}


def input_warnings(pred: Strands, true: Strands) -> list[str]:
    """Warnings on two sets of strands that should be of one head."""
    if not len(pred):
        return ["there are no predicted strands: precision is 0"]
    out = []
    boxes = [np.percentile(s.points, (1, 99), axis=0) for s in (pred, true)]
    mine, theirs = (float(np.linalg.norm(high - low)) for low, high in boxes)
    if max(mine, theirs) > OTHER_UNITS * min(mine, theirs):
        out.append(
            f"the predicted strands span {mine:.3g} m, the true ones {theirs:.3g} m: check that "
            "both are in metres"
        )
    elif _y_up(pred, true):
        out.append(
            "the predicted strands fit the true ones after conversion from y up to z up, "
            "(x, -z, y): check that both are z up"
        )
    elif (boxes[0][0] > boxes[1][1]).any() or (boxes[1][0] > boxes[0][1]).any():
        out.append(
            "the predicted and the true strands do not overlap: check that both are in one frame"
        )
    still = int((pred.lengths() == 0).sum())
    if still:
        out.append(f"{still} of {len(pred)} predicted strands have zero length")
    return out


def _y_up(pred: Strands, true: Strands) -> bool:
    """Whether conversion from y up to z up halves the distance of `pred` from `true`."""
    mine, theirs = (s.points[:: max(len(s.points) // 5000, 1)] for s in (pred, true))
    turned = mine[:, (0, 2, 1)] * np.array((1, -1, 1), np.float32)
    as_it_is, then = (
        sum(float(cKDTree(a).query(b)[0].mean()) for a, b in ((points, theirs), (theirs, points)))
        for points in (mine, turned)
    )
    return then < 0.5 * as_it_is


def root_figures(pred: Strands, true: Strands, head: Mesh | None = None) -> dict[str, Any]:
    """Shares of strands that reach the scalp, see `assess_strands`."""
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
