"""Sums of captured frames: light adds up, and an environment keeps its power."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from appearance.model.light_sums import (
    LightSums,
    few_lights,
    irradiance,
    lights_in_turn,
    weights_of_environment,
)
from reconstruction import Light
from reconstruction.geometry.lights import dome_positions

COLOURED = [
    Light(f"{name}{i}", p, np.eye(3)[k] * (2.0, 3.0, 4.0))
    for i, p in enumerate(dome_positions(60, 1.3))
    for k, name in enumerate("rgb")
]
"""A red, a green and a blue lamp in each of 60 places."""
DOME = [Light(f"l{i}", p, (2.0, 3.0, 4.0)) for i, p in enumerate(dome_positions(200, 1.3))]


def capture(frames: np.ndarray) -> SimpleNamespace:
    """As much of a capture as sums ask for: `frames (L, H, W, 3)` of the first lights."""
    names = [light.name for light in DOME[: len(frames)]]
    height, width = frames.shape[1:3]
    return SimpleNamespace(
        rig=SimpleNamespace(camera=lambda _: SimpleNamespace(height=height, width=width)),
        olat_lights=lambda: names,
        has_light=lambda light, _: light in names,
        light=lambda light, _: (frames[names.index(light)], None),
    )


def test_a_sum_is_that_of_its_frames_and_large_frames_are_their_means():
    frames = np.random.default_rng(1).gamma(1, 1, (9, 6, 8, 3)).astype(np.float32)
    weights = {"l2": (1.0, 0.5, 0.0), "l7": 2.0}
    expected = frames[2].astype(float) * (1, 0.5, 0) + 2 * frames[7].astype(float)
    np.testing.assert_allclose(LightSums(capture(frames), "c")(weights), expected, rtol=1e-6)
    small = LightSums(capture(frames), "c", memory=12 * 9 * 12)
    assert small.reduced == 2
    means = expected.reshape(3, 2, 4, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(small(weights), means, rtol=1e-6)
    with pytest.raises(ValueError, match="l9"):
        small({"l9": 1.0})


def test_an_even_environment_keeps_its_irradiance_and_spreads_it():
    weights = weights_of_environment(DOME, np.full((64, 128, 3), 0.7))
    power = weights * irradiance(DOME)
    np.testing.assert_allclose(power.sum(axis=0), 4 * np.pi * 0.7, rtol=1e-6)
    assert power.min() > 0.5 * power.mean()
    assert power.max() < 1.6 * power.mean()


@pytest.mark.parametrize("shape", [(1, 1), (2, 4), (5, 3)])
def test_of_a_map_of_few_texels_light_comes_from_everywhere(shape):
    """An even map is the same light, however many texels it has."""
    power = weights_of_environment(DOME, np.full((*shape, 3), 0.7)) * irradiance(DOME)
    np.testing.assert_allclose(power.sum(axis=0), 4 * np.pi * 0.7, rtol=1e-6)
    assert power.min() > 0.5 * power.mean()
    assert power.max() < 1.6 * power.mean()


def test_lamps_of_one_colour_and_lamps_that_look_away_keep_a_maps_light():
    """Each colour of an even map comes from all 60 places, by the lamps that have it."""
    away = Light("away", (0, 0, 1.29), (5, 5, 5), orientation=np.eye(3), size=(0.1, 0.1))
    lights = [*COLOURED, away]
    weights = weights_of_environment(lights, np.full((64, 128, 3), (0.7, 0.2, 0.4)))
    power = weights * irradiance(lights)
    np.testing.assert_allclose(power.sum(axis=0), 4 * np.pi * np.array((0.7, 0.2, 0.4)), rtol=1e-6)
    for k in range(3):
        assert not np.delete(weights[:, k], np.s_[k:180:3]).any()
        assert power[k:180:3, k].min() > 0.5 * power[k:180:3, k].mean()
    few = few_lights(lights, weights, 8)
    given = sum(w * irradiance(lights)[i] for i, w in few)
    np.testing.assert_allclose(given, power.sum(axis=0), rtol=1e-6)


@pytest.mark.parametrize(("rotation", "towards"), [(0, (1, 0, 0)), (90, (0, 1, 0))])
def test_the_middle_of_a_map_is_along_x_and_turns_counter_clockwise(rotation, towards):
    image = np.zeros((32, 64, 3))
    image[15:17, 31:33] = 5
    weights = weights_of_environment(DOME, image, rotation)
    brightest = DOME[int(weights[:, 0].argmax())].position / 1.3
    assert brightest @ np.array(towards) > np.cos(np.radians(12))


def test_few_lights_keep_the_power_and_few_stay_as_they_are():
    weights = np.random.default_rng(2).gamma(0.3, 1, (200, 3))
    chosen = few_lights(DOME, weights, 8)
    assert len(chosen) == 8
    own = irradiance(DOME)
    power = sum(w * own[i] for i, w in chosen)
    np.testing.assert_allclose(power, (weights * own).sum(axis=0), rtol=1e-9)
    two = np.zeros((200, 3))
    two[[5, 90]] = (1, 2, 3), (0.1, 0, 0)
    found = dict(few_lights(DOME, two, 8))
    assert set(found) == {5, 90}
    np.testing.assert_allclose(found[5], (1, 2, 3))
    assert few_lights(DOME, 0 * two, 8) == []


def test_in_the_mean_over_turns_every_light_stands_at_its_own_place():
    weights = np.random.default_rng(2).gamma(0.3, 1, (200, 3))
    turns = lights_in_turn(DOME, weights, 8, 4096)
    assert [len(x) for x in turns] == [4096] * 8
    mean = np.zeros_like(weights)
    for some in turns:
        for number, weight in some:
            mean[number] += weight / len(some)
    own = irradiance(DOME)
    # each light's turns are counted to 13 in 4096, by the discrepancy of the sequence
    most = 13 / 4096 * max(sum(w * own[i] for i, w in some).sum() / 4096 for some in turns)
    np.testing.assert_allclose(mean * own, weights * own, atol=most)
    two = np.zeros((200, 3))
    two[[5, 90]] = (1, 2, 3), (0.1, 0, 0)
    found = dict(one for (one,) in lights_in_turn(DOME, two, 8, 4))
    np.testing.assert_allclose(found[5], (1, 2, 3))
    np.testing.assert_allclose(found[90], (0.1, 0, 0))
