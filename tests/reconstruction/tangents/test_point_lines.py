"""Directions in which triangulated points lie in lines."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from reconstruction.light_planes.point_cloud import PointCloud
from reconstruction.tangents.line_evidence import half_sphere
from reconstruction.tangents.point_lines import (
    FEW,
    NEIGHBOURS,
    REACH,
    WIDTH,
    halves_of_lines,
    line_scores,
)

PIXEL = 4e-4
CANDIDATES = half_sphere(500)


def along(direction: np.ndarray, count: int = 41) -> np.ndarray:
    """Points on a line through the origin, a quarter of a pixel apart."""
    return np.linspace(-5, 5, count)[:, None] * PIXEL * direction


@pytest.mark.parametrize("pixel", [1e-5, 4e-4, 2e-2])
@pytest.mark.parametrize("degrees", [0, 37, 90])
def test_a_fibre_is_found_beside_fibres_that_cross_it_three_pixels_away(
    pixel: float, degrees: int
) -> None:
    a = np.radians(degrees)
    fibre = np.array([np.cos(a), 0.3, np.sin(a)]) / np.hypot(1, 0.3)
    across = np.cross(fibre, [0, 0.8, 0.6])
    beside = np.cross(fibre, across)
    others = [along(across / np.linalg.norm(across)) + k * 3 * PIXEL * beside for k in (-1, 1)]
    cloud = np.concatenate([along(fibre), *others]) * pixel / PIXEL
    scores = line_scores(np.zeros((1, 3)), cloud, pixel, CANDIDATES)[0]
    off = np.degrees(np.arccos(np.abs(CANDIDATES[scores.argmax()] @ fibre).clip(0, 1)))
    assert off < 6  # the candidates lie some 7 degrees apart


def test_the_score_of_neighbours_on_a_line_is_their_share() -> None:
    """All of n points lie on the line itself: n / (n + FEW) before the mean is taken off."""
    axis = np.array([0.0, 0.0, 1.0])
    others = np.array([[0, 0, 4.0], [0, 0, -4.0], [0, 0, 5.0]]) * PIXEL
    scores = line_scores(np.zeros((1, 3)), others, PIXEL, np.stack([axis, [1.0, 0, 0]]))[0]
    assert scores[0] - scores[1] == pytest.approx(3 / (3 + FEW), rel=1e-5)
    beside = others + np.array([WIDTH / 2 * PIXEL, 0, 0])
    scores = line_scores(np.zeros((1, 3)), beside, PIXEL, np.stack([axis, [0, 1.0, 0]]))[0]
    assert scores[0] - scores[1] == pytest.approx(0.75 * 3 / (3 + FEW), rel=1e-5)


def test_on_a_smooth_surface_all_tangents_score_alike_and_the_normal_least() -> None:
    x, y = np.meshgrid(*[np.linspace(-8, 8, 33) * PIXEL] * 2)
    plane = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    angles = np.radians(np.arange(0, 180, 15))
    tangents = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    scores = line_scores(np.zeros((1, 3)), plane, PIXEL, np.vstack([tangents, [0, 0, 1.0]]))[0]
    assert np.ptp(scores[:-1]) < 0.1 * (scores[:-1].mean() - scores[-1])


@pytest.mark.parametrize("others", [np.zeros((0, 3)), np.full((3, 3), 2 * REACH * PIXEL)])
def test_without_neighbours_no_direction_is_preferred(others: np.ndarray) -> None:
    assert not line_scores(np.zeros((2, 3)), others, PIXEL, CANDIDATES).any()


def test_more_points_than_neighbours_still_find_the_line() -> None:
    dense = along(np.array([0.6, 0.0, 0.8]), 50 * NEIGHBOURS)
    scores = line_scores(np.zeros((1, 3)), dense, PIXEL, CANDIDATES)[0]
    assert np.isfinite(scores).all()
    assert np.abs(CANDIDATES[scores.argmax()] @ [0.6, 0.0, 0.8]) > np.cos(np.radians(6))


def test_each_half_has_the_points_of_its_own_cameras(cloud_of: Callable[..., PointCloud]) -> None:
    one, other = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])
    points = np.concatenate([along(one), along(other)])
    cloud = cloud_of(points, np.repeat([2, 0], 41), ["a", "b", "c"])
    towards = np.stack([one, other])
    halves = halves_of_lines(np.zeros((1, 3)), cloud, ["b", "c"], PIXEL, towards)
    assert halves is not None
    assert halves[:, 0].argmax(axis=1).tolist() == [1, 0]
    empty = cloud_of(np.zeros((0, 3)), np.zeros(0), ["a", "b", "c"])
    assert halves_of_lines(np.zeros((1, 3)), empty, ["b"], PIXEL, towards) is None
    assert halves_of_lines(np.zeros((1, 3)), cloud, ["b"], 2e-3, towards) is None  # 12 mm long
