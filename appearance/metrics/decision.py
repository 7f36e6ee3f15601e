"""The stages of a fit, and the one rule by which each is kept or dropped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np

from reconstruction.arrays import AnyFloats, Array

Material = Literal["shared", "spatial", "correctives", "lights"]
"""Stages of inverse rendering: roughness and colour of all hair, maps over the scalp and along
strands, rotations of the fibres, intensities, axes and lobes of the lights."""
FitStage = Literal["sun", "shared", "spatial", "correctives", "lights", "field"]
MATERIAL: tuple[Material, ...] = get_args(Material)
STAGES: tuple[FitStage, ...] = get_args(FitStage)


def with_needed(stages: Sequence[FitStage]) -> tuple[FitStage, ...]:
    """`stages` in order, with "shared" before those of inverse rendering that start from it."""
    needed = {"shared"} if set(stages) & set(MATERIAL) else set()
    return tuple(name for name in STAGES if name in {*stages, *needed})


@dataclass(frozen=True)
class Decision:
    """Whether the result of a `stage` is kept: the root mean square errors on held-out frames.

    `skipped` is the reason why a stage was not run; the errors are then None.
    """

    stage: str
    before: float | None = None
    after: float | None = None
    standard_error: float | None = None
    skipped: str = ""
    seconds: float = 0.0

    @property
    def kept(self) -> bool:
        """Whether the error falls by more than its standard error."""
        if self.before is None or self.after is None or self.standard_error is None:
            return False
        return self.before - self.after > self.standard_error

    def __str__(self) -> str:
        if self.skipped:
            return f"{self.stage}: skipped, {self.skipped}"
        spread = "unknown" if self.standard_error is None else f"{self.standard_error:.4f}"
        return (
            f"{self.stage}: error on held-out frames {self.before:.4f} → {self.after:.4f}, "
            f"standard error {spread}: {'kept' if self.kept else 'dropped'}"
        )

    def to_dict(self) -> dict[str, Any]:
        """For JSON, with the line that is printed."""
        return {**asdict(self), "kept": self.kept, "line": str(self)}


def decide(
    stage: str, before: AnyFloats, after: AnyFloats, counts: AnyFloats, seconds: float = 0.0
) -> Decision:
    """The decision by sums of squared errors before and after a stage, and their counts `(V, B)`.

    V are views and B parts of the hair, none of them fitted. Sums are products of two independent
    renderings' errors: unbiased, and negative where noise exceeds the error. The estimator is the
    fall of the mean square, linear in the sums, with jackknife variances over views and over parts,
    which add up: noise of single parts of a view counts twice, so that the standard error is too
    large rather than too small. Both are divided by the sum of the root mean squares, by which they
    are the fall of the root mean square and its standard error; `after` is below 0 where its sum
    is. Nothing is kept by one part of one view, or if the sum `before` is not positive.
    """

    def fall(a: AnyFloats, b: AnyFloats, n: AnyFloats) -> Array:
        return (np.asarray(a) - b) / np.maximum(n, 1)

    variance, known = 0.0, False
    for axis in (0, 1):
        parts = [x.sum(axis) for x in (before, after, counts)]
        k = int((parts[2] > 0).sum())
        if k > 1:
            left = [(x.sum() - x)[parts[2] > 0] for x in parts]
            variance, known = variance + (k - 1) * float(np.var(fall(*left))), True
    total = [np.asarray(x.sum()) for x in (before, after, counts)]
    was, now = (float(np.sqrt(np.maximum(x, 0) / np.maximum(total[2], 1))) for x in total[:2])
    if not was > 0:
        return Decision(stage, was, was, None, seconds=seconds)
    error = variance**0.5 / (was + now) if known else None
    now = was - float(fall(*total)) / (was + now)
    return Decision(stage, was, now, error, seconds=seconds)
