"""Images reduced to normal equations in harmonics, so that iterations are independent of lights."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from appearance.render.harmonics import harmonics
from reconstruction import Light
from reconstruction.arrays import Floats, Ints


@dataclass(frozen=True, eq=False)
class Samples:
    """Pixels under single lights: `regressors` times harmonics of the light fit `targets`.

    `regressors` and `targets (2, L, P, 3)` are two halves of independent noise, whose errors'
    product is minimised: squares would be biased towards 0. `weight (L, P, 3)`; `points (P, 3)` are
    the origins of the directions to lights.
    """

    lights: tuple[Light, ...]
    points: Floats
    regressors: Floats
    targets: Floats
    weight: Floats

    def directions(self, degree: int, light: int) -> Floats:
        """The harmonics `(P, n)` of the directions from the points to a light by its number."""
        return harmonics(self.lights[light].position - self.points, degree)

    def under(self, lights: list[int]) -> Samples:
        """The same pixels under some of the lights, by their numbers."""
        few = tuple(self.lights[i] for i in lights)
        regressors, targets = self.regressors[:, lights], self.targets[:, lights]
        return replace(
            self, lights=few, regressors=regressors, targets=targets, weight=self.weight[lights]
        )


@dataclass(frozen=True, eq=False)
class Gram:
    """The weighted error of a view, as `Samples` has it, as a quadratic of its pixels' harmonics.

    For coefficients g `(P, n, 3)` it is the sum over pixels and channels of
    g · `matrix` g − 2 `right` · g, and a constant. `packed (P, 3, n(n + 1)/2)` holds the upper
    triangles of the symmetric matrices, `right (P, n, 3)`.
    """

    packed: Floats
    right: Floats

    @classmethod
    def of(cls, samples: Samples, degree: int) -> Gram:
        """The quadratic of `samples`."""
        lights = range(len(samples.lights))
        y = np.stack([samples.directions(degree, i) for i in lights]).astype(np.float32)
        upper = np.triu_indices(y.shape[-1])
        both = (y[..., upper[0]] * y[..., upper[1]]).transpose(1, 0, 2)  # (P, L, pairs)
        (x, other), (t, second), w = samples.regressors, samples.targets, samples.weight
        packed = np.matmul((w * x * other).transpose(1, 2, 0), both)
        across = np.float32(0.5) * w * (x * second + other * t)
        right = np.matmul(y.transpose(1, 2, 0), across.transpose(1, 0, 2))
        return cls(packed, right)

    def times(self, g: Floats) -> Floats:
        """The matrices times each of `g (P, n, 3, F)`."""
        n = g.shape[1]
        row, column = np.triu_indices(n)
        full = np.empty((*self.packed.shape[:2], n, n), np.float32)
        full[..., row, column] = self.packed
        full[..., column, row] = self.packed
        return np.asarray(np.matmul(full, g.transpose(0, 2, 1, 3)).transpose(0, 2, 1, 3))

    def diagonal(self, degrees: Ints) -> Floats:
        """The matrices' diagonals `(P, n, 3)`, their mean within each degree."""
        n = len(degrees)
        row, column = np.triu_indices(n)
        out = self.packed[..., row == column].transpose(0, 2, 1).copy()
        for k in np.unique(degrees):
            of_degree = degrees == k
            out[:, of_degree] = out[:, of_degree].mean(axis=1, keepdims=True)
        return np.asarray(out)
