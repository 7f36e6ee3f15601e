"""Lightcodes: packed, matched, and silent about lights that tell nothing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reconstruction.array_backend import array_types
from reconstruction.geometry.cameras import Camera
from reconstruction.light_codes.code_views import View
from reconstruction.light_codes.codes import code_map, match, pack, unpack
from reconstruction.light_codes.device_views import DeviceViews


@given(st.integers(1, 400), st.integers(0, 2**32 - 1))
def test_packing_is_undone_for_any_number_of_lights(count: int, seed: int) -> None:
    bits = np.random.default_rng(seed).random((3, 2, count)) < 0.5
    words = pack(bits)
    assert words.shape == (3, 2, -(-count // 32))
    np.testing.assert_array_equal(unpack(words, count), bits)


@given(st.integers(1, 400), st.integers(0, 2**32 - 1))
def test_matching_counts_the_compared_bits_alone(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b, compared = (rng.random((5, count)) < 0.5 for _ in range(3))
    found = match(pack(a), pack(b), pack(compared))
    for row in range(5):
        wanted = (a == b)[row][compared[row]].mean() if compared[row].any() else 1.0
        assert found[row] == pytest.approx(wanted)


def test_more_than_65535_equal_bits_do_not_overflow() -> None:
    words = np.full((1, 4096), 2**32 - 1, np.uint32)
    assert match(words, words, words)[0] == 1.0


def test_a_light_is_left_out_of_a_pair_only_if_both_views_say_nothing() -> None:
    mask = np.ones((1, 4), bool)
    dark = np.zeros((1, 1, 4))
    first = np.array([[[1, 1, 1, 1]], [[1, 0, 1, 0]], [[1, 1, 1, 1]]], float)
    second = np.array([[[1, 1, 1, 1]], [[1, 1, 1, 1]], [[0, 1, 1, 1]]], float)
    a, b = (code_map(np.concatenate([x, dark]), mask, 3) for x in (first, second))
    assert unpack(a.varying, 4).tolist() == [False, True, False, False]
    assert unpack(a.varying | b.varying, 4).tolist() == [False, True, True, False]


def test_the_threshold_is_the_median_under_the_furthest_light_or_three_sigma() -> None:
    mask = np.zeros((3, 3), bool)
    mask[1] = True
    responses = np.zeros((2, 3, 3))
    responses[0, 1] = [1.0, 0.3, 0.1]
    responses[1, 1] = [0.1, 0.2, 0.6]
    responses[:, 0] = 9.0  # off the mask
    found = code_map(responses, mask, 1)
    assert found.threshold == 0.2
    assert unpack(found.words, 2)[1].tolist() == [[True, False], [True, False], [False, True]]
    assert not found.words[0].any()
    assert code_map(responses, mask, 1, noise=0.15).threshold == pytest.approx(0.45)


def test_dimly_lit_pixels_are_reached_though_they_count_as_shadow() -> None:
    mask = np.ones((1, 40), bool)
    bright, dim = np.ones((1, 40)), np.full((1, 40), 0.02)
    dim[0, :2] = 1e-4  # behind something
    found = code_map(np.stack([bright, dim]), mask, 0)
    assert not unpack(found.words, 2)[..., 1].any()
    np.testing.assert_array_equal(unpack(found.reached, 2)[0, :, 1], [False] * 2 + [True] * 38)
    assert not unpack(code_map(np.stack([bright, dim]), mask, 0, 0.01).reached, 2)[..., 1].any()


def test_saturated_pixels_are_lit_and_dark_views_have_no_bits() -> None:
    mask = np.ones((1, 2), bool)
    clipped = np.zeros((1, 1, 2), bool)
    clipped[0, 0, 1] = True
    flat = np.full((1, 1, 2), 5.0)
    assert unpack(code_map(flat, mask, 0, saturated=clipped).words, 1).ravel().tolist() == [0, 1]
    dark = code_map(np.zeros((2, 1, 2)), mask, 0)
    assert not dark.words.any()
    assert not dark.varying.any()
    none = code_map(np.ones((2, 1, 2)), np.zeros((1, 2), bool), 0)
    assert not none.words.any()


def test_shapes_that_disagree_are_refused() -> None:
    with pytest.raises(ValueError, match="expected responses"):
        code_map(np.zeros((2, 3, 3)), np.zeros((3, 4), bool), 0)


def test_a_light_without_a_frame_in_one_view_is_not_compared_in_a_pair() -> None:
    """What one view has of it must not count as a difference; whoever stands beside it may see."""
    mask = np.ones((2, 2), bool)
    lit = np.array([[[1.0, 0.0], [1.0, 0.0]], [[0.0, 1.0], [1.0, 0.0]], [[0.0, 0.0], [0.0, 0.1]]])
    shot = np.array([False, True, True])
    whole = code_map(lit, mask, 2)
    part = code_map(np.where(shot[:, None, None], lit, 0), mask, 2, shot=shot)
    assert unpack(part.shot, 3).tolist() == [False, True, True]
    assert unpack(whole.varying, 3)[0]
    camera = Camera.look_at("a", 2, 2, (0, -1, 0), (0, 0, 0), 10.0)
    lines = np.full((2, 2, 2), 0.7, np.float32)
    views = [View(camera, mask, lines, codes, -1) for codes in (whole, part)]
    types = array_types()
    device = DeviceViews(types, views)
    compared = device.compared_lights(types.UInt32([0, 1, 0]), types.UInt32([1, 0, 0]))
    words = np.stack([np.asarray(w) for w in compared], axis=1).astype(np.uint32)
    bits = unpack(words, 3)
    assert not bits[:2, 0].any()
    assert bits[:2, 1].all()
    assert bits[2, 0]
