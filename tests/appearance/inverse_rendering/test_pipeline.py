"""Inverse rendering of a capture: what it leaves in the model, and going on after a kill."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from appearance import (
    Exposure,
    FittedModel,
    HairAppearance,
    HeldOut,
    InverseRenderingRequest,
    Sampling,
    fit_maps,
)
from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering import loop, pipeline
from appearance.inverse_rendering.loop import Outcome
from appearance.inverse_rendering.unknowns import decode, encode
from appearance.metrics.decision import Decision
from appearance.sun_fit.fitted_appearance import FittedAppearance
from reconstruction import (
    BadOptions,
    Capture,
    CaptureWriter,
    Model,
    ModelError,
    Rig,
    Step,
    Strands,
    parse_options,
)

REQUEST = parse_options(
    InverseRenderingRequest,
    {"max_depth": 5, "fit": {"shape": [2, 2, 2], "effort": {"pixels": 60, "spp": 8}}},
)
KEPT = [Decision("shared", 1.0, 0.5, 0.1)]
HELD_OUT = HeldOut(lights=("l1", "l3"))


@pytest.fixture(scope="module")
def made(plain, tufted, tmp_path_factory):
    """The tuft's frames as a capture, and a model that Sun's fit has left."""
    folder = tmp_path_factory.mktemp("inverse_rendering")
    cameras = tuple(o.camera for o in plain.views)
    steps = [Step(i, "olat", 0.02, light=x.name) for i, x in enumerate(plain.lights)]
    writer = CaptureWriter.create(
        folder / "capture",
        Rig("tuft", cameras, plain.lights),
        {"steps": [s.to_dict() for s in steps]},
    )
    model = Model(folder / "model").create()
    model.write_strands(tufted.strands)
    for o in plain.views:
        size = (o.camera.height, o.camera.width)
        mask = np.zeros(size, bool)
        mask.reshape(-1)[o.pixels] = True
        model.write_mask(o.camera.name, "hair", mask)
        for step, values in zip(steps, o.radiance, strict=True):
            image = np.zeros((*size, 3), np.float32)
            image[mask] = values
            writer.write_frame(step, o.camera.name, image)
    writer.finish("completed", {})
    start = HairAppearance((0.2, 0.2, 0.2), 0.4, 0.3)
    skin = (0.3, 0.3, 0.3)
    FittedAppearance(start, skin, skin, Exposure(plain.scale), 0.1, 0.1, 0.1, HeldOut()).save(model)
    return Capture(folder / "capture"), model


def test_killed_fit_resumes_and_writes_maps_lights_and_figures(made):
    capture, model = made
    report = model.report()
    with report.stage("field"):
        pass
    model.write_report(report)
    model.file("field.npz").write_bytes(b"of other maps")

    def killed(what, share):
        if what.startswith("correctives"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_maps(capture, model, held_out=HELD_OUT, request=REQUEST, progress=killed)
    assert model.checkpoint("stages").is_file()
    assert model.has("field.npz"), "an earlier fit stays until the new one is done"
    again = []
    result = fit_maps(
        capture,
        model,
        held_out=HELD_OUT,
        request=REQUEST,
        progress=lambda what, share: again.append((what, share)),
    )
    assert not [what for what, _ in again if what.startswith("spatial")], "it was done"
    assert [share for _, share in again] == sorted(share for _, share in again)
    assert [x["stage"] for x in result["stages"]] == ["shared", "spatial", "correctives", "lights"]
    assert "shared" in result["kept"], "one grey colour against the brown of the frames"
    assert result["rendered"] == "inverse_rendering"
    maps, uv = HairMaps.load(model)
    assert abs(maps.beta_m - 0.25) < abs(0.4 - 0.25) / 2
    assert uv.shape == (300, 2)
    lights = model.json("lights.json")
    assert [x["name"] for x in lights] == ["l0", "l2", "l4", "l5", "l6", "l7"]
    assert np.mean([np.log(x["gain"]) for x in lights]) == pytest.approx(0, abs=1e-6)
    assert not list(model.path.glob("*.checkpoint.npz"))
    assert not model.has("field.npz")
    stages = {stage.name: stage.figures for stage in model.report().stages}
    assert "field" not in stages
    assert stages["inverse_rendering"]["kept"] == result["kept"]


@pytest.mark.parametrize(
    ("given", "fitted", "by"),
    [(1, 1000, 1), (1, 6, 2), (1, 2, 3), (1, 1, 5), (2, 1000, 2), (2, 1, 4)],
)
def test_images_are_downsampled_to_four_hair_pixels_for_each_fitted_one(made, given, fitted, by):
    """Images of 20 x 20, the largest with 109 pixels of hair."""
    capture, model = made
    view = pipeline.reduced_for_fit(capture.view(reduced=given), model, fitted)
    assert view.reduced_by == by
    assert {(c.width, c.height) for c in view.rig.cameras} == {(20 // by, 20 // by)}


def test_where_no_stage_is_kept_suns_fit_is_rendered(made, tmp_path, monkeypatch):
    """White hair, offered for the brown of the frames, where Sun's fit is grey."""
    capture, model = made
    other = Model(tmp_path / "model")
    shutil.copytree(model.path, other.path)
    HairMaps.of(HairAppearance((0.1, 0.1, 0.1), 0.4, 0.3)).save(other, np.zeros((300, 2)))
    white = HairMaps.of(HairAppearance((0.001, 0.001, 0.001), 0.4, 0.3))

    def solve(problem, raw, gain, *args):
        return encode(white), gain, {}

    monkeypatch.setattr(loop, "solve_global_parameters", solve)
    found = fit_maps(capture, other, held_out=HELD_OUT, stages=["shared"], request=REQUEST)
    assert found["rendered"] == "sun_fit"
    assert found["stages"][0]["after"] > found["stages"][0]["before"]
    assert FittedModel.load(other, capture).maps.sigma_a.max() == pytest.approx(0.2)
    assert not other.has("hair_maps.npz")
    assert not other.report()["inverse_rendering"].warnings


@pytest.mark.parametrize(
    ("beta_n", "doubtful"), [(0.2, False), (0.7, False), (0.15, True), (0.1999, False)]
)
def test_a_start_at_a_limit_of_roughness_is_no_doubt_where_no_stage_moved_it(beta_n, doubtful):
    """Sun's fit holds beta_n at 0.2, a limit; encoding changes its last digits."""
    start = HairMaps.of(HairAppearance((0.2, 0.2, 0.2), 0.4, beta_n))
    found = pipeline._doubts(start, decode(encode(start)), measured=True)
    assert ["beta_n" in x for x in found] == [True] * doubtful
    moved = HairMaps.of(HairAppearance((0.2, 0.2, 0.2), 0.4, 0.2))
    begun = HairMaps.of(HairAppearance((0.2, 0.2, 0.2), 0.4, 0.3))
    assert pipeline._doubts(begun, moved, measured=True)[0].startswith("beta_n 0.20 is not inside")


@pytest.mark.parametrize(
    ("hair", "doubt"),
    [
        (HairAppearance((0.06, 0.12, 0.3), 0.93, 0.35), "beta_m 0.93 is not inside 0.05 to 0.8"),
        (HairAppearance((0.06, 0.12, 0.3), 0.4, 0.7), "beta_n 0.70 is not inside 0.2 to 0.7"),
        (HairAppearance((1.7, 1.7, 1.7), 0.36, 0.3), "beta_m 0.36 may be too rough"),
        (HairAppearance((0.2, 0.2, 0.2), 0.6, 0.3), "beta_m 0.60 differs from 0.40"),
    ],
)
def test_a_doubtful_roughness_is_warned_of(made, tmp_path, monkeypatch, hair, doubt):
    """Beyond what is; that of black hair from the grey start of `made`; far from that start."""
    capture, model = made
    other = Model(tmp_path / "model")
    shutil.copytree(model.path, other.path)
    far = HairMaps.of(hair)

    def found(problem, *args, **more):
        return Outcome(far, np.ones(len(problem.lights)), KEPT)

    monkeypatch.setattr(pipeline, "run", found)
    fit_maps(capture, other, request=REQUEST)
    (reported,) = other.report()["inverse_rendering"].warnings
    assert reported.startswith(doubt)


def test_a_parameter_that_images_do_not_determine_is_warned_of(made, tmp_path, monkeypatch):
    capture, model = made
    other = Model(tmp_path / "model")
    shutil.copytree(model.path, other.path)
    start = HairMaps.of(FittedAppearance.load(model).hair)

    def found(problem, *args, **more):
        known = {"beta_m": 0.1, "beta_n": 0.95}
        same = np.ones(len(problem.lights))
        return Outcome(start, same, KEPT, left_open=known)

    monkeypatch.setattr(pipeline, "run", found)
    fit_maps(capture, other, request=REQUEST)
    (reported,) = other.report()["inverse_rendering"].warnings
    assert reported.startswith("beta_n is undetermined")


def test_a_fit_beyond_free_memory_is_refused_before_it_starts(made, tmp_path, monkeypatch):
    capture, model = made
    other = Model(tmp_path / "model")
    shutil.copytree(model.path, other.path)
    effort = replace(REQUEST.fit.effort, pixels=10**6, spp=10**9)
    request = replace(REQUEST, fit=replace(REQUEST.fit, effort=effort))
    reported = []
    other.file("field.npz").write_bytes(b"an earlier field")
    monkeypatch.setattr(pipeline, "free_memory", lambda: 20.0)
    with pytest.raises(
        ModelError, match=r"takes about \d+\.\d GB of memory, and 20\.0 GB are free"
    ):
        fit_maps(
            capture, other, request=request, progress=lambda what, share: reported.append(what)
        )
    assert len(reported) == 1
    assert "GB of memory" in reported[0]
    assert other.has("field.npz")


FIT_ALONE = """
import sys
from appearance import InverseRenderingRequest, fit_maps
from reconstruction import Capture, Model, parse_options
from reconstruction.report.report import resident_memory
before = []
def progress(what, share):
    if "GB of memory" in what:
        before.append(resident_memory())
options = {"max_depth": 3, "fit": {"effort": {"pixels": 100, "spp": 8}}}
capture, model = Capture(sys.argv[1]), Model(sys.argv[2])
request = parse_options(InverseRenderingRequest, options)
fit_maps(capture, model, request=request, progress=progress)
stage = model.report()["inverse_rendering"]
print(before[0], stage.figures["memory_needed_gb"], stage.peak_gb)
"""


@pytest.mark.slow
def test_the_predicted_memory_is_what_the_process_takes(made, tmp_path):
    """By the kernel's own account of a process that does nothing else."""
    if str(mi.variant()).startswith("cuda"):
        pytest.skip("what is told is of the CPU: of a GPU's memory the kernel knows nothing")
    capture, model = made
    other = Model(tmp_path / "model")
    shutil.copytree(model.path, other.path)
    few = model.strands()
    points = np.concatenate([few.points + np.float32(1e-5 * k) for k in range(150)])
    other.write_strands(Strands.from_list(list(points.reshape(-1, 8, 3)), few.radius))
    FittedAppearance.load(model).save(other)
    alone = [sys.executable, "-c", FIT_ALONE, str(capture.path), str(other.path)]
    done = subprocess.run(alone, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    before, reported, peak = (float(x) for x in done.stdout.split())
    assert reported == pytest.approx(peak, rel=0.3)
    assert reported - before == pytest.approx(peak - before, rel=0.4)


def test_unknown_fields_of_the_fit_are_refused_by_name():
    with pytest.raises(BadOptions, match=r"options.fit.stepps: "):
        parse_options(InverseRenderingRequest, {"fit": {"stepps": 3}})


@pytest.mark.slow
def test_the_fitted_head_casts_its_shadow(made, small, tmp_path):
    """A board under the tuft, of which the capture knows nothing, hides the lights below it."""
    capture, model = made
    below = [x.name for x in capture.rig.lights if x.position[2] < -0.2]
    board = small.plane()
    board = replace(board, vertices=board.vertices + np.array([0, 0, -0.035]))
    black = []
    for head in (None, board):
        other = Model(tmp_path / str(head is None))
        shutil.copytree(model.path, other.path)
        if head is not None:
            other.write_head(head)
        fitted = FittedModel.load(other, capture)
        camera, lights = capture.rig.cameras[0], fitted.lights(below[:2])
        black.append(fitted.render(camera, lights, [], Sampling(64, 5)).sum())
    assert capture.head is None
    assert black[1] < 0.02 * black[0]
