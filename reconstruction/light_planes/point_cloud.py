"""Triangulated points on hair and skin, with their rays and covariances."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reconstruction.arrays import Array, Floats
from reconstruction.files.durable import writing
from reconstruction.files.numpy_files import read_arrays


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Triangulated points in the reference pose (that of the first tracking frame).

    points (N, 3)         float64, metres
    covariance (N, 3, 3)  float64, m²: along the ray from row and angle, across from the pixel
    view (N, 3)           float64, unit direction from the point to its camera
    pixel (N, 2)          int32, (x, y) in that camera's image at the time of the step, not in the
                          reference pose
    camera (N,)           int16, index into `cameras`
    projector (N,)        int16, index into `projectors`
    row (N,)              float32, fractional row of the projector at the temporal maximum
    step (N,)             int32, `Step.index` of the frame with the maximum
    brightness (N,)       float32, response at the maximum, mean of the channels, W/(sr m²)
    weight (N,)           float32 in (0, 1]: the squared ratio of the best attainable deviation
                          along the ray to this point's

    Raises `ValueError` when shapes disagree or a coordinate is not finite.
    """

    points: Array
    covariance: Array
    view: Array
    pixel: NDArray[np.int32]
    camera: NDArray[np.int16]
    projector: NDArray[np.int16]
    row: Floats
    step: NDArray[np.int32]
    brightness: Floats
    weight: Floats
    cameras: tuple[str, ...]
    projectors: tuple[str, ...]

    def __post_init__(self) -> None:
        n = len(self.points)
        for name, (shape, kind) in _COLUMNS.items():
            value: NDArray[Any] = np.ascontiguousarray(getattr(self, name), dtype=kind)
            if value.shape != (n, *shape):
                raise ValueError(f"point cloud: {name} must be {(n, *shape)}, got {value.shape}")
            if not np.isfinite(value).all():
                raise ValueError(f"point cloud: {name} must be finite")
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def empty(cls, cameras: tuple[str, ...], projectors: tuple[str, ...]) -> PointCloud:
        """A cloud without points."""
        columns: dict[str, NDArray[Any]] = {
            k: np.zeros((0, *shape), kind) for k, (shape, kind) in _COLUMNS.items()
        }
        return cls(**columns, cameras=cameras, projectors=projectors)

    @classmethod
    def merged(cls, clouds: list[PointCloud]) -> PointCloud:
        """The points of clouds that share cameras and projectors; at least one cloud."""
        first = clouds[0]
        if any((c.cameras, c.projectors) != (first.cameras, first.projectors) for c in clouds):
            raise ValueError("point clouds of different rigs cannot be merged")
        columns = {k: np.concatenate([getattr(c, k) for c in clouds]) for k in _COLUMNS}
        return cls(**columns, cameras=first.cameras, projectors=first.projectors)

    def subset(self, which: ArrayLike) -> PointCloud:
        """The points at the indices (or the mask) `which (M,)`."""
        index = np.arange(len(self))[np.asarray(which)]
        columns = {k: getattr(self, k)[index] for k in _COLUMNS}
        return PointCloud(**columns, cameras=self.cameras, projectors=self.projectors)

    def of_camera(self, name: str) -> PointCloud:
        """The points of the camera `name`."""
        return self.subset(self.camera == self.cameras.index(name))

    def deviation_along_view(self) -> Array:
        """Standard deviation along the ray `(N,)`, metres."""
        variance = np.einsum("ni,nij,nj->n", self.view, self.covariance, self.view)
        return np.asarray(np.sqrt(variance))

    def save(self, path: str | Path) -> None:
        """Write a compressed `.npz`; the reverse of `load`."""
        columns = {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}
        with writing(Path(path)) as temporary:
            np.savez_compressed(temporary, allow_pickle=False, **columns)

    @classmethod
    def load(cls, path: str | Path) -> PointCloud:
        """Read what `save` wrote; `ValueError` names the file and the column that is missing."""
        try:
            data = read_arrays(Path(path))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        missing = [f.name for f in fields(cls) if f.name not in data]
        if missing:
            raise ValueError(f"{path}: not a point cloud, {missing} are missing")
        columns = {k: data[k] for k in _COLUMNS}
        cameras, projectors = (tuple(str(n) for n in data[k]) for k in ("cameras", "projectors"))
        return cls(**columns, cameras=cameras, projectors=projectors)


_COLUMNS: dict[str, tuple[tuple[int, ...], type]] = {
    "points": ((3,), np.float64),
    "covariance": ((3, 3), np.float64),
    "view": ((3,), np.float64),
    "pixel": ((2,), np.int32),
    "camera": ((), np.int16),
    "projector": ((), np.int16),
    "row": ((), np.float32),
    "step": ((), np.int32),
    "brightness": ((), np.float32),
    "weight": ((), np.float32),
}
