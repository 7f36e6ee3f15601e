"""Captured frames under any light, to the last of 8 bits."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np

from reconstruction import Light
from reconstruction.geometry.lights import dome_positions
from stage_service.viewer.lighting import Lighting
from stage_service.viewer.packing import PackedStrands


def test_a_sum_of_frames_is_exact_to_8_bits(model):
    """Beside a sum in float64, the sRGB curve as the standard prints it, rounded once."""
    rng = np.random.default_rng(4)
    frames = rng.gamma(0.5, 0.02, (40, 24, 32, 3)).astype(np.float32)
    lights = [Light(f"l{i}", p, (1, 1, 1)) for i, p in enumerate(dome_positions(40, 1.3))]
    by_name = {light.name: (light, i) for i, light in enumerate(lights)}
    capture = SimpleNamespace(
        olat_lights=lambda: list(by_name),
        has_light=lambda *_: True,
        light=lambda name, _: (frames[by_name[name][1]], None),
        rig=SimpleNamespace(
            camera=lambda _: SimpleNamespace(height=24, width=32),
            light=lambda name: by_name[name][0],
        ),
    )
    lighting = Lighting(model, capture, PackedStrands.of(model.strands()))
    weights = {i: rng.uniform(0, 2, 3).tolist() for i in range(0, 40, 3)}
    png = lighting.sum("c", weights, exposure=1.7)
    found = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)[..., ::-1]

    x = 1.7 * sum(frames[i].astype(float) * w for i, w in weights.items())
    x = np.clip(x, 0, 1)
    shown = 255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    near_half = np.abs(shown % 1 - 0.5) < 1e-3  # float32 may round those the other way
    assert (found == np.rint(shown))[~near_half].all()
    assert near_half.mean() < 0.01
    assert 20 < found.mean() < 235
