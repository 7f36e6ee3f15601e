"""Motion of the subject during the sweep: a smooth, seeded random walk."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from reconstruction.arrays import Array

_TURN_DEG_PER_M = 0.4 / 1.5e-3  # a head that sways by 1.5 mm also turns by about 0.4°


class Drift:
    """Rigid poses `x -> rotation @ x + translation` of the subject against pose 0.

    Over `poses` poses the translation reaches `reach` metres and the rotation 0.4° for every
    1.5 mm of it; beyond them the walk runs back and forth.
    """

    def __init__(self, poses: int, reach: float, seed: int) -> None:
        if poses < 1 or not 0 <= reach < np.inf:
            raise ValueError(
                f"drift needs poses >= 1 and a finite reach >= 0 m, got {poses} and {reach}"
            )
        rng = np.random.default_rng([seed, 0xD21F7])
        steps = rng.normal(size=(max(poses, 2), 6))
        walk = gaussian_filter1d(np.cumsum(steps, axis=0), 1.0, axis=0)
        walk -= walk[0]
        turns, shifts = walk[:, :3], walk[:, 3:]
        self._shifts = shifts * (reach / np.linalg.norm(shifts, axis=1).max())
        angle = np.radians(_TURN_DEG_PER_M * reach)
        self._turns = turns * (angle / np.linalg.norm(turns, axis=1).max())
        self.poses = poses

    def pose(self, index: int) -> tuple[Array, Array]:
        """Rotation `(3, 3)` and translation `(3,)`, metres, of pose `index`; pose 0 is at rest."""
        period = 2 * max(self.poses - 1, 1)
        k = index % period
        k = min(k, period - k)
        return Rotation.from_rotvec(self._turns[k]).as_matrix(), self._shifts[k].copy()

    def to_dicts(self) -> list[dict[str, Any]]:
        """All poses, ready for JSON."""
        out = []
        for k in range(self.poses):
            rotation, translation = self.pose(k)
            out.append(
                {"pose": k, "rotation": rotation.tolist(), "translation": translation.tolist()}
            )
        return out
