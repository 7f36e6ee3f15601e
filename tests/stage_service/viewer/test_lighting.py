"""Captured frames under any light, to the last of 8 bits."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from appearance import FittedModel
from appearance.inverse_rendering.fitted_lights import save_lights
from reconstruction import Camera, Capture, CaptureWriter, Light, ModelError, Rig, Step
from reconstruction.geometry.lights import dome_positions
from stage_service.viewer.lighting import Lighting
from stage_service.viewer.packing import PackedStrands
from stage_service.viewer.viewed import Viewed


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


def shot(folder, reflectance, lights, without=()):
    """A capture of the camera "c" whose frames are `answers (L, H, W, 3)`, some of them missing."""
    camera = Camera.look_at("c", 32, 24, (0, -1, 0), (0, 0, 0), 20.0)
    steps = [Step(i, "olat", 0.02, light=x.name) for i, x in enumerate(lights)]
    writer = CaptureWriter.create(folder, Rig("r", (camera,), lights), {"steps": steps})
    for step, radiance in zip(steps, reflectance, strict=True):
        if step.light not in without:
            writer.write_frame(step, "c", radiance.astype(np.float32))
    writer.finish("completed", {})
    return Capture(folder)


@pytest.mark.parametrize("scale", [1e-4, 1e3])
def test_without_a_fit_frames_are_neither_black_nor_white(model, tmp_path, scale):
    """Whatever the unit of an import: the 99th percentile of all frames is about white."""
    reflectance = scale * np.random.default_rng(6).gamma(0.5, 1, (12, 24, 32, 3))
    lights = tuple(Light(f"l{i}", p, (1, 1, 1)) for i, p in enumerate(dome_positions(12, 1.3)))
    lighting = Viewed(model, shot(tmp_path / "capture", reflectance, lights)).lighting
    description = lighting.about()
    white = description["exposure"] * np.percentile(reflectance, 99)
    assert white == pytest.approx(1, rel=0.1)
    png = lighting.sum("c", {3: [1, 1, 1]}, description["exposure"])
    found = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert 40 < found.mean() < 200
    assert Viewed(model).lighting.about()["exposure"] == 1


def test_a_missing_frame_is_stood_for_by_that_of_the_nearest_light(model, tmp_path):
    """Light from there comes from beside it, as much of it; a map can still be shown."""
    reflectance = np.random.default_rng(7).gamma(0.5, 0.02, (3, 24, 32, 3))
    places = ((0, -1.0, 0), (0, -2.0, 0.2), (0, 1.0, 0))
    lights = tuple(Light(f"l{i}", p, (1, 1, 1)) for i, p in enumerate(places))
    capture = shot(tmp_path / "capture", reflectance, lights, without=("l1",))
    lighting = Viewed(model, capture).lighting
    assert lighting.about()["missing"] == {"c": 1}
    png = lighting.sum("c", {i: [1, 2, 3] for i in range(3)}, exposure=1.3)
    found = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)[..., ::-1]
    # l1 is twice as far: over 4.04 squared metres
    x = np.clip(
        1.3 * np.array((1, 2, 3)) * (reflectance[0] * (1 + 1 / 4.04) + reflectance[2]), 0, 1
    )
    shown = 255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    assert np.abs(found - shown).max() < 0.51


def test_lights_shine_as_inverse_rendering_found_them(model, tmp_path):
    places = dome_positions(3, 1.3)
    lights = tuple(Light(f"l{i}", p, (4, 4, 4)) for i, p in enumerate(places))
    save_lights(model, np.array([0.5, 1, 1]), lights)
    lighting = Viewed(model, shot(tmp_path / "capture", np.ones((3, 24, 32, 3)), lights)).lighting
    (description,) = lighting.few({0: [1, 1, 1]})
    np.testing.assert_allclose(description["intensity"], 2)


def test_all_lights_together_are_the_captured_frame_of_all(model, tmp_path):
    """A capture on disk, of other levels and exposures; the frame with all lights
    on, which no sum reads, is what a camera without noise would have seen."""
    rng = np.random.default_rng(5)
    lights = tuple(Light(f"l{i}", p, (1, 1, 1)) for i, p in enumerate(dome_positions(12, 1.3)))
    camera = Camera.look_at("c", 32, 24, (0, -1, 0), (0, 0, 0), 20.0)
    reflectance = rng.gamma(0.5, 0.02, (12, 24, 32, 3))
    olat = [Step(1 + i, "olat", 0.02, 0.5, light=x.name) for i, x in enumerate(lights)]
    steps = [Step(0, "all_on", 0.005, 0.25), *olat]
    writer = CaptureWriter.create(
        tmp_path / "capture", Rig("r", (camera,), lights), {"steps": steps}
    )
    for step, radiance in zip(steps, (reflectance.sum(axis=0), *reflectance), strict=True):
        writer.write_frame(step, "c", (step.level * radiance).astype(np.float32))
    writer.finish("completed", {})
    capture = Capture(tmp_path / "capture")
    all_on = capture.frame(capture.steps[0], "c") / 0.25

    lighting = Viewed(model, capture).lighting
    png = lighting.sum("c", {i: [1, 1, 1] for i in range(12)}, exposure=1.3)
    found = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)[..., ::-1]
    x = np.clip(1.3 * all_on.astype(float), 0, 1)
    shown = 255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    near_half = np.abs(shown % 1 - 0.5) < 1e-3  # float32 may round those the other way
    assert (found == np.rint(shown))[~near_half].all()
    assert near_half.mean() < 0.01
    assert 20 < found.mean() < 235


def test_what_is_prepared_is_not_traced_again(model, monkeypatch):
    FittedModel.unfitted(model).save(model)
    viewed = Viewed(model)
    viewed.prepare()
    monkeypatch.setattr("stage_service.viewer.lighting.reached", None)
    head, packed = viewed.head, viewed.packed("model")
    assert len(viewed.lighting.visibility(0)) == packed.points[..., 0].size + len(head.vertices)


def test_a_damaged_fit_stops_at_the_first_light_not_before(model):
    (model.path / "appearance.json").write_text("{")
    viewed = Viewed(model)
    viewed.prepare()
    with pytest.raises(ModelError):
        viewed.lighting.visibility(0)
