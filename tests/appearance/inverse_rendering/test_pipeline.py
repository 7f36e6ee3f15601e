"""Inverse rendering of a capture: what it leaves in the model, and going on after a kill."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace

import cv2
import mitsuba as mi
import numpy as np
import pytest

from appearance import (
    Exposure,
    FittedModel,
    HairAppearance,
    HeldOut,
    InverseRenderingRequest,
    fit_maps,
)
from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering import loop, pipeline
from appearance.inverse_rendering.loop import Outcome
from appearance.inverse_rendering.unknowns import encode
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
    {
        "judged_spp": 64,
        "max_depth": 5,
        "fit": {
            "variant": "lights",
            "shape": [2, 2, 2],
            "effort": {"pixels": 60, "spp": 8},
        },
    },
)
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
    reported = []

    def killed(what, share):
        reported.append((what, share))
        if what.startswith("correctives"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_maps(capture, model, held_out=HELD_OUT, request=REQUEST, progress=killed)
    assert model.checkpoint("lights").is_file()
    again = []
    result = fit_maps(
        capture,
        model,
        held_out=HELD_OUT,
        request=REQUEST,
        progress=lambda what, share: again.append((what, share)),
    )
    assert not [what for what, _ in again if what.startswith("cells")], "they were solved for"
    assert [share for _, share in again] == sorted(share for _, share in again)
    assert set(result["held_out"]) == {"start", "inverse_rendering"}
    before, after = (result["held_out"][k]["psnr"] for k in ("start", "inverse_rendering"))
    assert after > before, "one grey colour against the brown of the frames"
    picture = cv2.imread(str(model.file("inverse_rendering.png")))
    # four frames, each captured, before, after and its error map
    assert picture.shape[0] > 3.5 * picture.shape[1] / 4
    maps, uv = HairMaps.load(model)
    assert maps.shape == (2, 2, 2)
    assert abs(maps.beta_m - 0.25) < abs(0.4 - 0.25) / 2
    assert uv.shape == (300, 2)
    lights = model.json("lights.json")
    assert [x["name"] for x in lights] == ["l0", "l2", "l4", "l5", "l6", "l7"]
    assert np.mean([np.log(x["gain"]) for x in lights]) == pytest.approx(0, abs=1e-6)
    assert not list(model.path.glob("*.checkpoint.npz"))
    stage = model.report()["inverse_rendering"]
    assert [s.name for s in stage.series] == [
        "inverse rendering, original",
        "inverse rendering, lights",
    ]


def test_held_out_cameras_are_judged_under_the_fitted_lights(made, tufted, tmp_path, monkeypatch):
    """With the true hair under lights found to be twice as bright, a picture is all wrong."""
    capture, model = made
    other = Model(tmp_path / "model")
    shutil.copytree(model.path, other.path)
    truth = HairMaps.of(tufted.truth)

    def found(problem, *args, **more):
        return Outcome(truth, np.full(len(problem.lights), 2.0), "converged", 1.0, 0.5)

    monkeypatch.setattr(pipeline, "run", found)
    request = replace(REQUEST, judged_spp=256)
    judged = fit_maps(capture, other, held_out=HeldOut(cameras=("c1",)), request=request)[
        "held_out"
    ]
    assert judged["inverse_rendering"]["relative_error"] == pytest.approx(1, abs=0.2)
    assert judged["start"]["relative_error"] < 0.8


def test_a_fit_that_is_not_taken_leaves_suns_to_be_rendered(made, tmp_path, monkeypatch):
    """White hair, offered for the brown of the frames, where Sun's fit is grey."""
    capture, model = made
    other = Model(tmp_path / "model")
    shutil.copytree(model.path, other.path)
    for name in ("hair_maps.npz", "lights.json"):
        other.remove(name)
    white = HairMaps.of(HairAppearance((0.001, 0.001, 0.001), 0.4, 0.3))

    def solve(problem, raw, gain, *args):
        return encode(white), gain, {}

    monkeypatch.setattr(loop, "solve_global_parameters", solve)
    request = replace(REQUEST, fit=replace(REQUEST.fit, variant="original"))
    found = fit_maps(capture, other, held_out=HELD_OUT, request=request)
    assert not found["accepted"]
    assert found["error"] > found["start_error"]
    assert FittedModel.load(other, capture).maps.sigma_a.max() == pytest.approx(0.2)
    assert not other.has("hair_maps.npz")
    (warning,) = other.report()["inverse_rendering"].warnings
    assert warning.startswith("original: rejected")


@pytest.mark.slow
def test_a_fit_that_is_stopped_leaves_what_was_rendered_and_one_that_ends_replaces_it(
    made, tufted, tmp_path, monkeypatch
):
    capture, model = made
    other = Model(tmp_path / "model")
    shutil.copytree(model.path, other.path)
    before, after = HairMaps.of(tufted.truth), HairMaps.of(replace(tufted.truth, beta_m=0.35))
    before.save(other, np.zeros((300, 2)))
    other.write_json("lights.json", [])
    other.file("field.npz").write_bytes(b"of the maps before")
    report = other.report()
    with report.stage("field"):
        pass
    other.write_report(report)

    def found(problem, *args, **more):
        return Outcome(after, np.ones(len(problem.lights)), "converged", 1.0, 0.5)

    def killed(*args):
        raise KeyboardInterrupt

    def files():
        return {k: p.read_bytes() for k, p in other.artifacts().items() if "work" not in k}

    was = files()
    monkeypatch.setattr(pipeline, "run", found)
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "judge", killed)
        with pytest.raises(KeyboardInterrupt):
            fit_maps(capture, other, held_out=HELD_OUT, request=REQUEST)
    assert files() == was
    fit_maps(capture, other, held_out=HELD_OUT, request=REQUEST)
    assert HairMaps.load(other)[0].beta_m == 0.35
    assert len(other.json("lights.json")) == 6
    assert not other.has("field.npz")
    assert "field" not in [stage.name for stage in other.report().stages]
    assert set(files()) == set(was) - {"field.npz"} | {"inverse_rendering.png"}


@pytest.mark.parametrize(
    ("hair", "doubt"),
    [
        (HairAppearance((0.06, 0.12, 0.3), 0.93, 0.35), "beta_m 0.93 lies outside 0.05 to 0.8"),
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
        return Outcome(far, np.ones(len(problem.lights)), "converged", 1.0, 0.5)

    monkeypatch.setattr(pipeline, "run", found)
    (reported,) = fit_maps(capture, other, request=REQUEST)["doubts"]
    assert reported.startswith(doubt)


def test_a_parameter_that_images_do_not_determine_is_warned_of(made, tmp_path, monkeypatch):
    capture, model = made
    other = Model(tmp_path / "model")
    shutil.copytree(model.path, other.path)
    start = HairMaps.of(FittedAppearance.load(model).hair)

    def found(problem, *args, **more):
        known = {"beta_m": 0.1, "beta_n": 0.95}
        same = np.ones(len(problem.lights))
        return Outcome(start, same, "converged", 1.0, 0.5, left_open=known)

    monkeypatch.setattr(pipeline, "run", found)
    (reported,) = fit_maps(capture, other, request=REQUEST)["doubts"]
    assert reported.startswith("beta_n is undetermined")


def test_a_fit_beyond_free_memory_is_refused_before_it_starts(made, tmp_path, monkeypatch):
    capture, model = made
    other = Model(tmp_path / "model")
    shutil.copytree(model.path, other.path)
    effort = replace(REQUEST.fit.effort, pixels=10**6, spp=10**9)
    request = replace(REQUEST, fit=replace(REQUEST.fit, effort=effort))
    reported = []
    monkeypatch.setattr(pipeline, "free_memory", lambda: 20.0)
    with pytest.raises(
        ModelError, match=r"takes about \d+\.\d GB of memory, and 20\.0 GB are free"
    ):
        fit_maps(
            capture, other, request=request, progress=lambda what, share: reported.append(what)
        )
    assert len(reported) == 1
    assert "GB of memory" in reported[0]


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
    request = replace(REQUEST, fit=replace(REQUEST.fit, variant="original"))
    errors = []
    for head in (None, board):
        other = Model(tmp_path / str(head is None))
        shutil.copytree(model.path, other.path)
        if head is not None:
            other.write_head(head)
        found = fit_maps(capture, other, held_out=HeldOut(lights=tuple(below[:2])), request=request)
        errors.append(found["held_out"]["start"]["relative_error"])
    assert capture.head is None
    assert abs(errors[0] - 1) > 0.2
    assert errors[1] == pytest.approx(1.0, abs=0.02)  # black under lights that the board hides
