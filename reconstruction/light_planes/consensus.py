"""What the points of a sweep say about one another: outliers, support, and the local plane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import Array, Bools
from reconstruction.light_planes.point_cloud import PointCloud


def supported(points: Array, neighbours: int, isolation: float) -> Bools:
    """Which `points (N, 3)` are not outliers `(N,)`.

    A point stays whose distance to its neighbour number `neighbours` is at most `isolation` times
    the median of that distance over all points; with `neighbours` 0 all stay. With too few points
    to tell, none stays.
    """
    if neighbours < 1:
        return np.ones(len(points), bool)
    if len(points) <= neighbours:
        return np.zeros(len(points), bool)
    distance = cKDTree(points).query(points, k=[neighbours + 1])[0][:, 0]
    return np.asarray(distance <= isolation * np.median(distance))


def support(points: Array, radius: float, neighbours: int = 32) -> Array:
    """How much other points back each of `points (N, 3)`: `(N,)` in (0, 1), 0.5 for the median.

    Neighbours count by a Gaussian of `radius` metres, at most `neighbours` of them, and each point
    counts for itself.
    """
    if not len(points):
        return np.zeros(0)
    k = min(neighbours, len(points) - 1) + 1
    distance = cKDTree(points).query(points, k=k)[0].reshape(len(points), k)
    score = np.exp(-0.5 * (distance / radius) ** 2).sum(axis=1)
    return np.asarray(score / (score + np.median(score)))


def flatten(cloud: PointCloud, radius: float, roughness: float, neighbours: int = 40) -> PointCloud:
    """Let each point use its neighbours' plane as a measurement of deviation `roughness` (metres).

    The plane is that of the neighbours within about `radius` metres, weighted by their information
    and `PointCloud.weight`; the update is Kalman's, so that a point moves in the direction, and by
    the share, that its own covariance leaves open. Pixels blur a surface's detail sideways and rows
    along the ray: both are averaged out where neighbours agree. Points with under eight neighbours
    within 2 `radius` stay as they are.
    """
    n = len(cloud)
    k = min(neighbours, n - 1)
    if k < 8:
        return cloud
    distance, index = cKDTree(cloud.points).query(cloud.points, k=k + 1)
    variance = cloud.deviation_along_view() ** 2
    near = np.exp(-0.5 * (distance / radius) ** 2) * (distance <= 2 * radius)
    weight = near * (cloud.weight / (variance + roughness**2))[index]
    weight /= weight.sum(axis=1, keepdims=True)
    neighbour = cloud.points[index]
    mean = np.einsum("nk,nki->ni", weight, neighbour)
    offset = neighbour - mean[:, None]
    moments = np.einsum("nk,nki,nkj->nij", weight, offset, offset)
    normal = np.linalg.eigh(moments)[1][:, :, 0]
    residual = np.einsum("ni,ni->n", cloud.points - mean, normal)
    gain = np.einsum("nij,nj->ni", cloud.covariance, normal)
    total = np.einsum("ni,ni->n", gain, normal) + roughness**2
    use = (near > 0).sum(axis=1) > 8
    step = np.where(use, residual / total, 0.0)[:, None] * gain
    reduced = gain[:, :, None] * gain[:, None, :] / total[:, None, None]
    return replace(
        cloud,
        points=cloud.points - step,
        covariance=cloud.covariance - np.where(use[:, None, None], reduced, 0.0),
    )
