"""Mitsuba behind the wires: the pictures that the simulated cameras take."""

from __future__ import annotations

import functools
import os

import numpy as np
import pytest

from simulators.frames.render_process import RenderError, RenderProcess
from simulators.frames.responses import MitsubaResponder, Quality, reproducible
from simulators.subject.drift import Drift
from simulators.subject.subject import make_subject

QUALITY = Quality(lights=128, sweep=16, together=256, depth=4, sweep_depth=2)


@pytest.fixture(scope="module")
def subject():
    return make_subject("straight", 1, strands=300)


@pytest.fixture(scope="module")
def responder(tiny_rig, subject):
    """One renderer for all tests here: kernels are compiled once."""
    drift = Drift(3, 0.0, 0)
    make = functools.partial(reproducible, tiny_rig, subject, drift, QUALITY, 0)
    process = RenderProcess(make)
    yield process
    process.stop()


def test_each_lamp_lights_the_subject_from_its_side(responder, tiny_rig):
    response = responder.lights("cam_a")
    assert response.images.shape == (5, len(response.pixels), 3)
    assert 60 < len(response.pixels) < 256
    assert (response.images >= 0).all()
    facing = [light.position @ tiny_rig.camera("cam_a").center for light in tiny_rig.lights]
    mean = response.images.mean(axis=(1, 2))
    assert mean.argmax() == np.argmax(facing)
    assert mean.max() > 2 * mean[np.argmin(facing)]


def test_all_lamps_together_are_the_sum_of_each(responder):
    """Two estimators of one picture: every lamp alone, and a sample of them at each vertex."""
    power = np.array([1, 0.5, 0, 0.25, 1])
    each = responder.lights("cam_a")
    together = responder.lights_together("cam_a", 1, power)
    assert np.array_equal(each.pixels, together.pixels)
    weighted = np.tensordot(power, each.images, 1)
    assert together.images[0].mean() == pytest.approx(weighted.mean(), rel=0.06)


def test_rows_light_bands_of_the_subject(responder):
    sweep = responder.sweep("cam_a", 0)["proj"]
    assert sweep.images.shape == (8, len(sweep.pixels), 3)
    images = sweep.images.astype(np.float32)
    lit = images.sum(axis=(1, 2))
    assert (lit > 0).sum() >= 3
    assert images.max(axis=0).sum() > 0.4 * images.sum()  # one row a pixel, mostly


def test_the_same_seed_renders_the_same_bytes(responder):
    first, second = (responder.lights("cam_b") for _ in range(2))
    assert first.images.tobytes() == second.images.tobytes()


def test_an_error_in_the_renderer_reaches_the_caller(responder):
    with pytest.raises(RenderError, match="no camera 'nobody'"):
        responder.lights("nobody")


def test_a_moving_subject_moves_in_the_frames(tiny_rig, subject):
    """2 cm of drift, exaggerated to show at 16 pixels, against the shift that geometry predicts."""
    drift = Drift(3, 0.02, 1)
    still = MitsubaResponder(tiny_rig, subject, drift, QUALITY, 0)
    camera = tiny_rig.camera("cam_a")

    def middle(pose):
        pixels = still.lights_together("cam_a", pose, np.ones(5)).pixels
        return np.array([(pixels % 16).mean(), (pixels // 16).mean()])

    k = max(range(3), key=lambda k: np.linalg.norm(drift.pose(k)[1][[0, 2]]))
    rotation, translation = drift.pose(k)
    points = subject.strands.points.astype(float)
    before, after = (camera.project(p)[0] for p in (points, points @ rotation.T + translation))
    expected = after.mean(axis=0) - before.mean(axis=0)
    assert np.linalg.norm(expected) > 0.5
    assert middle(k) - middle(0) == pytest.approx(expected, abs=0.5)


def test_the_exit_of_a_renderer_is_reported():
    process = RenderProcess(functools.partial(os._exit, 7))
    with pytest.raises(RenderError, match="exit code 7"):
        process.lights("cam_a")
    process.stop()
