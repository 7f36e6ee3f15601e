"""The radius and weight that a capture's own cameras agree on."""

from __future__ import annotations

import numpy as np
import pytest

from reconstruction.tangents.line_evidence import decide, half_sphere
from reconstruction.tangents.pooling import MOST_RADIUS, Evidence, chosen, pool

SPACING = 5e-4


def plane(side: int = 40) -> np.ndarray:
    """Points of a plane, `SPACING` apart."""
    x, y = np.meshgrid(*[SPACING * np.arange(side)] * 2)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def halves(truth: np.ndarray, noise: float, seed: int = 0) -> np.ndarray:
    """Scores `(2, N, D)` of directions by two sets of cameras, of independent noise."""
    rng = np.random.default_rng(seed)
    clean = (half_sphere(200) @ truth.T).T ** 2
    return (clean + noise * rng.standard_normal((2, *clean.shape))).astype(np.float32)


def turning(points: np.ndarray, period: float) -> np.ndarray:
    """Directions in the plane that turn by half a turn over `period` metres."""
    angle = np.pi * points[:, 0] / period
    return np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)


def error(points: np.ndarray, radius: float, scores: np.ndarray, truth: np.ndarray) -> float:
    """Median degrees between pooled directions and true ones."""
    found = decide(pool(points, radius, 96) @ scores.sum(axis=0), half_sphere(200)).directions
    cosine = np.abs((found * truth).sum(axis=1)).clip(0, 1)
    return float(np.degrees(np.median(np.arccos(cosine))))


def test_straight_noisy_hair_is_averaged_widely_and_turning_hair_narrowly() -> None:
    points = plane()
    straight = chosen(points, SPACING, Evidence(halves(turning(points, 1e3), 3.0)))
    curled = chosen(points, SPACING, Evidence(halves(turning(points, 4e-3), 0.5)))
    assert straight.radius >= 4 * SPACING
    assert curled.radius <= 3 * SPACING
    assert straight.weight == curled.weight == 0


@pytest.mark.parametrize("noise", [0.3, 1.0, 3.0])
def test_the_radius_is_near_the_best_that_the_truth_would_choose(noise: float) -> None:
    points = plane()
    truth = turning(points, 8e-3)
    scores = halves(truth, noise)
    found = chosen(points, SPACING, Evidence(scores))
    errors = [error(points, k * SPACING, scores, truth) for k in (1, 1.5, 2, 3, 4, 6, 8)]
    assert error(points, found.radius, scores, truth) < 1.25 * min(errors) + 1.0


@pytest.mark.parametrize("blur", [3e-3, 5e-3])
def test_what_texture_blurs_itself_is_not_blurred_more(blur: float) -> None:
    """Locks that turn within 4 mm; texture shows twice as much of the flow around them.

    Both halves see that flow alike, so that the widest averages of it agree the best.
    """
    points = plane(60)
    x, y = 2 * np.pi * points[:, :2].T / 4e-3
    angle = 0.6 * np.sin(x) * np.sin(y)
    truth = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    own = ((half_sphere(200) @ truth.T).T ** 8).astype(np.float32)
    noise = np.random.default_rng(0).standard_normal((2, *own.shape))
    scores = (own + 2 * (pool(points, blur, 400) @ own) + 0.3 * noise).astype(np.float32)
    found = chosen(points, SPACING, Evidence(scores))
    errors = [error(points, k * SPACING, scores, truth) for k in (1, 1.5, 2, 3, 4, 6, 8)]
    assert error(points, found.radius, scores, truth) < 1.25 * min(errors)


def test_evidence_of_noise_gets_no_weight_and_the_other_all() -> None:
    points = plane()
    truth = turning(points, 20e-3)
    good, noise = halves(truth, 0.3), halves(truth, 1e3, seed=1)
    assert chosen(points, SPACING, Evidence(good, noise / 1e3)).weight <= 0.15
    assert chosen(points, SPACING, Evidence(noise / 1e3, good)).weight >= 3.0


def test_faint_reflection_that_errs_alike_in_all_cameras_gets_no_weight_beside_points() -> None:
    """All cameras see the same shadows, so their reflection agrees on a wrong direction."""
    points = plane()
    truth = turning(points, 20e-3)
    texture = halves(truth, 2.0)
    wrong = halves(turning(points, 20e-3)[:, [1, 0, 2]], 0.3, seed=1)
    lines = halves(truth, 2.0, seed=2) / 10
    found = chosen(points, SPACING, Evidence(texture, wrong, lines), contrast=1.5)
    assert found.weight <= 0.3
    assert found.lines >= 4
    clear = chosen(points, SPACING, Evidence(texture, wrong, lines), contrast=10.0)
    assert clear.weight >= 0.8  # a clear highlight is believed
    assert chosen(points, SPACING, Evidence(texture, wrong)).weight >= 0.8


def test_lines_of_points_that_add_nothing_are_left_out() -> None:
    points = plane()
    truth = turning(points, 20e-3)
    clear, chance = halves(truth, 0.3), halves(truth, 1e3, seed=1)
    reflection = halves(truth, 0.3, seed=2)
    assert chosen(points, SPACING, Evidence(clear, reflection, chance / 1e4)).lines == 0


def test_given_weights_stay_and_count_in_the_sum() -> None:
    points = plane(10)
    kinds = [halves(turning(points, 8e-3), 0.5, seed) for seed in range(3)]
    evidence = Evidence(*kinds)
    found = chosen(points, SPACING, evidence, 1e-3, 0.25, 7.0)
    assert (found.radius, found.weight, found.lines) == (1e-3, 0.25, 7.0)
    expected = sum(
        w * k.astype(float).sum(axis=0) for w, k in zip((1, 0.25, 7), kinds, strict=True)
    )
    np.testing.assert_allclose(found.total(evidence), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("count", [1, 2])
def test_few_points_and_flat_scores_still_give_a_radius(count: int) -> None:
    points = plane(2)[:count]
    flat = np.zeros((2, count, 200), np.float32)
    found = chosen(points, 1.0, Evidence(flat, flat, flat))
    assert 0 < found.radius <= MOST_RADIUS
    assert np.isfinite(found.agreement)


def test_cameras_that_share_no_point_leave_the_usual_radius_and_weight() -> None:
    """Every score of the second half is 0: there is nothing to predict."""
    points = plane(10)
    scores = halves(turning(points, 8e-3), 0.5)
    scores[1] = 0
    found = chosen(points, SPACING, Evidence(scores, scores, scores))
    assert (found.radius, found.weight, found.lines) == (4 * SPACING, 0.5, 0.0)
    assert found.agreement == 0


def test_scores_that_are_not_numbers_are_refused() -> None:
    points = plane(10)
    scores = np.full((2, len(points), 200), np.nan, np.float32)
    with pytest.raises(ValueError, match="must be finite"):
        chosen(points, SPACING, Evidence(scores))
