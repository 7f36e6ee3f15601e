"""Which of two fits is rendered is decided on frames that neither was fitted to."""

import numpy as np
import pytest

from appearance import Exposure, FittedModel, HairAppearance, HeldOut, InverseRenderingRequest
from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering import pipeline
from appearance.inverse_rendering.fitted_lights import save_lights
from appearance.model import validated
from appearance.model.validated import far_apart, fit_validated
from appearance.sun_fit.fitted_appearance import FittedAppearance
from reconstruction import (
    Camera,
    Capture,
    CaptureWriter,
    Light,
    Model,
    ModelError,
    Report,
    Rig,
    Step,
    Strands,
)
from reconstruction.geometry.lights import dome_positions

SUN = HairAppearance((0.2, 0.2, 0.2), 0.4, 0.3)
FOUND = HairMaps.of(HairAppearance((0.1, 0.2, 0.4), 0.2, 0.3), (2, 2, 2))
HELD_OUT = HeldOut(("cam_1",), ("l3",))
REQUEST = InverseRenderingRequest(lights=8, validation_lights=3)


@pytest.fixture
def made(tmp_path):
    """A capture of two cameras and 20 lights, and a model that Sun's fit has left."""
    cameras = tuple(
        Camera.look_at(f"cam_{i}", 4, 4, (x, -1, 0), (0, 0, 0), 10.0) for i, x in enumerate((0, 1))
    )
    lights = tuple(
        Light(f"l{i}", p, np.ones(3)) for i, p in enumerate(dome_positions(20, 1.0, -60.0))
    )
    steps = [Step(i, "olat", 0.02, light=x.name) for i, x in enumerate(lights)]
    writer = CaptureWriter.create(
        tmp_path / "capture", Rig("r", cameras, lights), {"steps": [s.to_dict() for s in steps]}
    )
    for step in steps:
        for camera in cameras:
            writer.write_frame(step, camera.name, np.ones((4, 4, 3), np.float32))
    writer.finish("completed", {})
    model = Model(tmp_path / "model").create()
    model.write_strands(Strands(np.eye(3, dtype=np.float32), np.array([0, 3]), 4e-4))
    rest = ((0.1,) * 3, (0.3,) * 3, Exposure(1.0), 0.1, 0.1, 0.1, HELD_OUT)
    FittedAppearance(SUN, *rest).save(model)
    return Capture(tmp_path / "capture"), model


def fit_that_scores(psnr: float, recorded: list[tuple[set[str], set[str]]]):
    """In the place of `fit_maps`: its maps and lights, Sun's fit at 20 dB, its own at `psnr`."""

    def fit(capture, model, *, held_out, request, progress, seed):
        training = held_out.training(capture)
        recorded.append(({c.name for c in training.rig.cameras}, set(training.olat_lights())))
        FOUND.save(model, np.array([[0.5, 0.5]]))
        lights = [capture.rig.light(n) for n in training.olat_lights()]
        save_lights(model, np.full(len(lights), 2.0), lights)
        report = Report()
        with report.stage("inverse_rendering"):
            pass
        model.write_report(report)
        scores = {"start": {"psnr": 20.0}, "inverse_rendering": {"psnr": psnr}}
        return {"held_out": scores, "ended": "converged", "accepted": True, "doubts": ["rough"]}

    return fit


@pytest.mark.parametrize(("psnr", "rendered"), [(20.5, FOUND.beta_m), (19.5, SUN.beta_m)])
def test_the_better_fit_on_validation_frames_is_rendered(made, monkeypatch, psnr, rendered):
    capture, model = made
    recorded = []
    monkeypatch.setattr(validated, "fit_maps", fit_that_scores(psnr, recorded))
    result = fit_validated(capture, model, held_out=HELD_OUT, request=REQUEST)
    ((cameras, lights),) = recorded
    assert cameras == {"cam_0"}
    assert len(lights) == 8
    assert "l3" not in lights
    fitted = FittedModel.load(model, capture)
    assert fitted.maps.beta_m == rendered
    assert (result["rendered"] == "sun_fit") == (rendered == SUN.beta_m)
    gains = {light.intensity[0] for light in fitted.rig.lights if light.name in lights}
    assert gains == ({1.0} if rendered == SUN.beta_m else {2.0})
    both = FittedModel.alternatives(model, capture)
    found = {"sun_fit": SUN.beta_m, "inverse_rendering": FOUND.beta_m}
    assert {name: fit.maps.beta_m for name, fit in both.items()} in (found, {})
    assert bool(both) == (rendered == FOUND.beta_m)
    warnings = model.report()["inverse_rendering"].warnings
    (warning,) = warnings
    assert ("20.00 dB against 19.50" in warning) == (rendered == SUN.beta_m)
    assert (warning == "rough") == (rendered != SUN.beta_m), "of what is rendered alone"


def test_a_fit_that_is_refused_for_memory_leaves_the_field(made, monkeypatch):
    capture, model = made
    model.file("field.npz").write_bytes(b"an earlier field")
    model.write_mask("cam_0", "hair", np.ones((4, 4), bool))
    monkeypatch.setattr(pipeline, "free_memory", lambda: 1e-4)
    with pytest.raises(ModelError, match="GB of memory"):
        fit_validated(capture, model, held_out=HELD_OUT, request=REQUEST)
    assert model.has("field.npz")


def test_directions_far_apart():
    # from one pole of an octahedron: the other pole, then the equator
    octahedron = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, -2], [-1, 0, 0], [0, -1, 0]])
    order = far_apart(octahedron.astype(float), 9)
    assert order[:2] == [0, 3]
    assert sorted(order) == list(range(6))
    assert far_apart(octahedron.astype(float), 1) == [0]
