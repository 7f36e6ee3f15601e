"""Strands traced through lines that were measured on helices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from reconstruction.growth.surface_strands import SurfaceOptions, surface_strands
from reconstruction.tangents.estimate import Measured

RADIUS, PITCH = 5e-3, 30e-3


def helix(t: np.ndarray, aside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and unit tangents at angles `t (N,)` of helices about the z axis moved by `aside`."""
    rise = PITCH / (2 * np.pi)
    p = np.stack([RADIUS * np.cos(t), RADIUS * np.sin(t), rise * t], axis=1) + aside
    d = np.stack([-RADIUS * np.sin(t), RADIUS * np.cos(t), np.full(len(t), rise)], axis=1)
    return p, d / np.linalg.norm(d, axis=1, keepdims=True)


def lock(count: int, noise: float, angle_deg: float) -> Measured:
    """A lock of parallel helices, measured with errors across and of angle; signs are scrambled."""
    rng = np.random.default_rng(1)
    t = rng.uniform(0, 4 * np.pi, count)
    p, d = helix(t, rng.choice(np.linspace(-1e-3, 1e-3, 5), (count, 3)) * [1, 1, 0])
    p += noise * rng.normal(size=p.shape)
    d += np.radians(angle_deg) * rng.normal(size=d.shape)
    d *= rng.choice([-1, 1], (count, 1)) / np.linalg.norm(d, axis=1, keepdims=True)
    return Measured(p, d, rng.uniform(0.3, 1.0, count))


def errors(paths: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Distance (metres) of every point to the lock's middle and its angle (degrees) to it."""
    t = np.linspace(-0.5 * np.pi, 4.5 * np.pi, 4000)
    truth, along = helix(t, np.zeros((len(t), 3)))
    points = np.concatenate(paths).astype(float)
    tangents = np.concatenate([np.gradient(p.astype(float), axis=0) for p in paths])
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    distance, i = cKDTree(truth).query(points)
    cosine = np.abs((along[i] * tangents).sum(axis=1)).clip(0, 1)
    return distance, np.degrees(np.arccos(cosine))


def test_noisy_lines_become_strands_that_are_better_than_they() -> None:
    lines = lock(2500, 4e-4, 12.0)
    paths = surface_strands(lines)
    distance, angle = errors(paths)
    assert np.median(angle) < 5  # the lines themselves: 12 or so
    assert np.median(distance) < 7e-4  # locks are a millimetre wide either way
    lengths = np.array([len(p) for p in paths]) * SurfaceOptions().step * SurfaceOptions().apart
    assert lengths.max() > 40e-3  # a turn of the helix is 43 mm long


def test_every_line_is_passed_and_the_same_strand_is_not_traced_twice() -> None:
    lines = lock(8000, 1e-4, 2.0)
    paths = surface_strands(lines)
    far = cKDTree(np.concatenate(paths)).query(lines.points)[0]
    assert (far < 1.5e-3).mean() > 0.99
    assert len(paths) < 200  # of 8000 lines
    more = surface_strands(lines, SurfaceOptions(spacing=0.3))
    assert len(paths) < 0.5 * len(more)


def test_a_strand_crosses_others_without_turning_into_them() -> None:
    x = np.linspace(-0.02, 0.02, 400)
    zero = np.zeros_like(x)
    points = np.concatenate([np.stack([x, zero, zero], 1), np.stack([zero, x, zero], 1)])
    directions = np.repeat(np.eye(3)[:2], len(x), axis=0)
    for path in surface_strands(Measured(points, directions, np.ones(len(points)))):
        assert min(np.ptp(path[:, 0]), np.ptp(path[:, 1])) < 1e-5
        assert np.ptp(path, axis=0).max() > 0.035


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_lines_make_no_strand(count: int) -> None:
    lines = lock(50, 0.0, 0.0)
    few = Measured(lines.points[:count], lines.directions[:count], lines.confidence[:count])
    assert surface_strands(few) == []


def test_lines_in_one_place_and_lines_without_confidence() -> None:
    same = Measured(np.zeros((30, 3)), np.tile([0, 0, 1.0], (30, 1)), np.ones(30))
    for path in surface_strands(same):
        assert np.isfinite(path).all()
        assert np.ptp(path[:, 2]) < 6e-3  # nothing to follow beyond two bandwidths
    assert surface_strands(replace(same, confidence=np.zeros(30))) == []
