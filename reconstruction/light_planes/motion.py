"""The subject's rigid motion during the sweep, from its tracking frames (Photobooth §3.1)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation, Slerp

from reconstruction.arrays import Array, Bools, Ints

Between = Literal["interpolate", "hold"]


@dataclass(frozen=True, eq=False)
class Motion:
    """Rigid motions `x -> rotation @ x + translation` from the reference pose.

    steps (T,)            `Step.index` of the tracking frames at whose time they hold, ascending
    rotations (T, 3, 3), translations (T, 3) in metres
    between               what holds between tracking frames: "interpolate" (rotation on SO(3),
                          translation linearly) suits people, "hold" a subject that only moves at
                          tracking frames
    still                 no motion above the noise of the measurement
    determined            directions of motion, of 6, that the cameras determine (the least)
    lost (L,)             `Step.index` of tracking frames without a pose: the motion is unknown
                          from the tracking frame before each to the one after it
    """

    steps: Ints
    rotations: Array
    translations: Array
    between: Between = "interpolate"
    still: bool = False
    determined: int = 6
    lost: Ints = field(default_factory=lambda: np.zeros(0, np.int64))

    def __post_init__(self) -> None:
        t = len(self.steps)
        if np.shape(self.rotations) != (t, 3, 3) or np.shape(self.translations) != (t, 3):
            raise ValueError(
                f"motion of {t} tracking frames needs rotations ({t}, 3, 3) and translations "
                f"({t}, 3), got {np.shape(self.rotations)} and {np.shape(self.translations)}"
            )
        if (np.diff(self.steps) <= 0).any():
            raise ValueError(f"tracking steps must ascend, got {self.steps}")

    @classmethod
    def none(cls, steps: ArrayLike = ()) -> Motion:
        """The motion at `steps (T,)` of a subject that kept still."""
        index = np.asarray(steps, np.int64)
        n = len(index)
        return cls(index, np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), still=True)

    def at(self, steps: ArrayLike) -> tuple[Array, Array]:
        """Rotations `(N, 3, 3)` and translations `(N, 3)` at the steps `(N,)`; ends are held."""
        index = np.asarray(steps, float).reshape(-1)
        if self.still or not len(self.steps):
            return np.tile(np.eye(3), (len(index), 1, 1)), np.zeros((len(index), 3))
        knots = self.steps.astype(float)
        if self.between == "hold" or len(knots) == 1:
            which = np.clip(np.searchsorted(knots, index, side="right") - 1, 0, len(knots) - 1)
            return self.rotations[which], self.translations[which]
        time = np.clip(index, knots[0], knots[-1])
        rotations = Slerp(knots, Rotation.from_matrix(self.rotations))(time).as_matrix()
        columns = [np.interp(time, knots, self.translations[:, k]) for k in range(3)]
        return np.asarray(rotations), np.stack(columns, axis=1)

    def known(self, steps: ArrayLike) -> Bools:
        """Whether the pose at the steps `(N,)` is known: it depends on no lost tracking frame."""
        index = np.asarray(steps, np.int64).reshape(-1)
        if not len(self.lost):
            return np.ones(len(index), bool)
        frames = np.sort(np.concatenate([self.steps, self.lost]))
        lost = np.isin(frames, self.lost)
        before = np.clip(np.searchsorted(frames, index, side="right") - 1, 0, len(frames) - 1)
        unknown = lost[before]
        if self.between == "interpolate":
            unknown |= lost[np.minimum(before + 1, len(frames) - 1)] & (index > frames[before])
        return ~unknown

    def undo(
        self, steps: ArrayLike, points: Array, view: Array, covariance: Array
    ) -> tuple[Array, Array, Array]:
        """Bring `points (N, 3)`, directions and covariances measured at `steps (N,)` back."""
        rotation, translation = self.at(steps)
        back = rotation.transpose(0, 2, 1)
        moved = np.einsum("nij,nj->ni", back, points - translation)
        return moved, np.einsum("nij,nj->ni", back, view), back @ covariance @ rotation

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready: rotations as rotation vectors in radians, translations in metres."""
        vectors = Rotation.from_matrix(self.rotations).as_rotvec() if len(self.steps) else []
        return {
            "steps": self.steps.tolist(),
            "rotations_rad": np.asarray(vectors).tolist(),
            "translations_m": self.translations.tolist(),
            "between": self.between,
            "still": self.still,
            "determined": self.determined,
            "lost": self.lost.tolist(),
        }
