"""The fit on hair that curls, which straight strands stand for."""

import numpy as np
import pytest

from appearance import HairAppearance, Sampling, build_scene, fit
from appearance.render.coverage import coverage
from appearance.render.smoothed import olat_smoothed
from appearance.sun_fit.options import FitOptions
from reconstruction import Camera, Capture, CaptureWriter, Light, Model, Rig, Step, Strands
from reconstruction.geometry.lights import dome_positions

FIBRE = 0.25


def curtain(lean_deg: float, pitch: float) -> Strands:
    """3,000 helices of 10 cm, each in a phase of its own."""
    rng, count, along = np.random.default_rng(3), 3000, np.linspace(0, 0.1, 120)
    root = rng.uniform((-0.03, -0.008, 0.05), (0.03, 0, 0.05), (count, 3))
    turn = 2 * np.pi * along / pitch + rng.uniform(0, 2 * np.pi, (count, 1))
    out = np.tan(np.radians(lean_deg)) * pitch / (2 * np.pi)
    curl = np.stack([out * np.cos(turn), out * np.sin(turn), 0 * turn - along], axis=2)
    return Strands.from_list(list((root[:, None] + curl).astype(np.float32)), radius=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("lean_deg", "pitch"), [(0, 0.03), (12, 0.06), (18, 0.03)])
def test_curls_that_strands_do_not_have_leave_the_truth_in_the_interval(lean_deg, pitch, tmp_path):
    cameras = tuple(
        Camera.look_at(f"cam_{i}", 48, 48, (x, -0.6, 0), (0, 0, 0), 5.5)
        for i, x in enumerate((-0.2, 0.2))
    )
    lights = tuple(
        Light(f"light_{i}", place, np.full(3, 5.0))
        for i, place in enumerate(dome_positions(120, 1.0, -60.0))
    )
    steps = [Step(i, "olat", 0.02, light=light.name) for i, light in enumerate(lights)]
    plan = {"steps": [step.to_dict() for step in steps]}
    capture = CaptureWriter.create(tmp_path / "capture", Rig("curls", cameras, lights), plan)
    model = Model(tmp_path / "model").create()
    model.write_strands(curtain(0, pitch))
    hair = HairAppearance((0.15, 0.3, 0.6), FIBRE, 0.2)
    scene = build_scene(curtain(lean_deg, pitch), None, hair=hair)
    for camera in cameras:
        seen = coverage(scene, camera)["hair"]
        model.write_mask(camera.name, "hair", seen > 0.9)
        model.write_mask(camera.name, "skin", seen < 0)
        frames = olat_smoothed(scene, camera, lights, Sampling(16, 16, 7))
        for step, frame in zip(steps, frames, strict=True):
            capture.write_frame(step, camera.name, frame)
    capture.finish("completed", {})
    options = FitOptions(hair_pixels=500, roughness_cameras=2)
    report = fit(Capture(tmp_path / "capture"), model, options=options)
    found, warnings = report["roughness"].figures, report["roughness"].warnings
    assert found["low"] < FIBRE < found["high"] < 3 * found["low"]
    if lean_deg:
        assert any("single hairs turn" in warning for warning in warnings)
    else:
        assert found["beta_m"] == pytest.approx(FIBRE, rel=0.015)
