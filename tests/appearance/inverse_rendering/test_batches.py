"""Which pairs are drawn, and that drawing them unevenly does not change what is minimised."""

from __future__ import annotations

import numpy as np
import pytest

from appearance.inverse_rendering.batches import Batch, Comparison, Pairs
from appearance.inverse_rendering.problem import FitProblem
from appearance.observations import Observed
from reconstruction import Camera, Light

PIXELS = 50


def view(brightness, invalid=()):
    """A camera's frames of flat brightness, one a light."""
    camera = Camera.look_at("c", 10, 10, (0, -1, 0), (0, 0, 0), 20)
    lights = tuple(Light(f"l{i}", (0, 0, 1), np.ones(3)) for i in range(len(brightness)))
    radiance = np.ones((len(brightness), PIXELS, 3), np.float32)
    radiance *= np.array(brightness, np.float32)[:, None, None]
    valid = np.ones(radiance.shape[:2], bool)
    valid[list(invalid)] = False
    return Observed(camera, lights, np.arange(PIXELS), radiance, valid)


def test_black_saturated_and_grazing_frames_are_never_drawn():
    grazing = view([1.0] * 4)
    grazing.radiance[3] = 0
    grazing.radiance[3, :2] = 5
    pairs = Pairs([view([1, 1, 0.001, 1], invalid=[1]), grazing], scale=1.0)
    assert pairs.used.tolist() == [[True, False, False, True], [True, True, True, False]]
    rng = np.random.default_rng(0)
    for _ in range(20):
        batch = pairs.draw(2, rng)
        assert pairs.used[batch.view, batch.lights].all()


@pytest.mark.parametrize("images", [1, 3, 8])
def test_the_weighted_sum_over_batches_is_the_mean_over_pairs(images):
    pairs = Pairs([view([1] * 6), view([1] * 6)], scale=1.0)
    loss = np.arange(12.0).reshape(2, 6)
    pairs.squared_error = (loss - 2) ** 2
    rng = np.random.default_rng(1)
    drawn = [pairs.draw(images, rng) for _ in range(4000)]
    mean = np.mean([(b.share * loss[b.view, b.lights]).sum() for b in drawn])
    assert mean == pytest.approx(loss.mean(), rel=0.05)
    assert {len(set(b.lights)) for b in drawn} <= {min(images, 6), min(images, 6) - 1}


def test_pairs_with_larger_errors_are_drawn_more_often_and_noise_counts_for_nothing():
    pairs = Pairs([view([1] * 4)], scale=1.0)
    batch = Batch(0, np.arange(4), np.ones(4))
    rng = np.random.default_rng(2)
    captured = np.ones((4, PIXELS, 3))
    valid = np.ones((4, PIXELS), bool)
    for _ in range(30):
        rendered = captured.copy()
        rendered[1] += 0.5  # wrong everywhere
        rendered[2] += rng.normal(scale=0.5, size=(PIXELS, 3))  # right, but noisy
        pairs.update(batch, Comparison(rendered, captured, captured, valid))
    chance = pairs.chance()[0]
    assert chance[1] > 2 * max(chance[0], chance[2], chance[3])
    assert chance.sum() == pytest.approx(1)
    even = Pairs([view([1] * 4)], scale=1.0, weighted=False)
    even.squared_error = pairs.squared_error
    np.testing.assert_allclose(even.chance(), 0.25)


@pytest.mark.parametrize(("cameras", "wanted"), [(5, 3), (4, 3), (8, 3), (7, 2), (2, 3)])
def test_views_that_decide_are_spread_over_all_cameras(cameras, wanted):
    """Cameras stand in order around the head: no gap between those taken is twice an even one."""
    views = [view([1, 1]) for _ in range(cameras)]
    pairs, problem = Pairs(views, 1.0), FitProblem(None, views, 1.0, np.ones(3))
    taken = [b.view for b in problem.spread(pairs, wanted, 2)]
    assert len(set(taken)) == len(taken) == min(wanted, cameras)
    gaps = np.diff([*taken, taken[0] + cameras])
    assert gaps.max() < 2 * cameras / len(taken)
    assert gaps.max() - gaps.min() <= 1
