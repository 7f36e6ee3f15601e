"""The whole fit on a small capture that was rendered with a known appearance."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from appearance import Exposure, HairAppearance, HeldOut, build_scene, fit, render_olat
from appearance.bsdf.longitudinal import variance_of_roughness
from appearance.observations import chosen, observe
from appearance.render.coverage import coverage
from appearance.sun_fit.fit_pixels import check_strands
from appearance.sun_fit.fitted_appearance import FittedAppearance
from appearance.sun_fit.options import FitOptions
from reconstruction import (
    Camera,
    Capture,
    CaptureError,
    CaptureWriter,
    Light,
    Mesh,
    Model,
    ModelError,
    Report,
    Rig,
    Stage,
    Step,
    Strands,
    write_strands,
)
from reconstruction.geometry.lights import dome_positions

TRUTH = HairAppearance((0.15, 0.3, 0.6), 0.25, 0.2)
SKIN = (0.4, 0.3, 0.2)
LEFT_OUT = HeldOut(("cam_2",), ("l5", "l7"))
OPTIONS = FitOptions(hair_pixels=200, roughness_cameras=2, roughness_spp=36, error_paths=30_000)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A board of skin behind a curtain of fibres: 2 cameras of 24², 40 lights, one of them dark."""
    folder = tmp_path_factory.mktemp("fit")
    rng = np.random.default_rng(3)
    n = 700
    roots = np.stack(
        [rng.uniform(-0.04, 0.0, n), rng.uniform(-0.01, 0.0, n), np.full(n, 0.05)], axis=1
    )
    lean = rng.normal(scale=0.02, size=(n, 3)) * [1, 1, 0] + [0, 0, -1]
    t = np.linspace(0, 0.1, 6)
    points = (roots[:, None] + t[None, :, None] * lean[:, None]).reshape(-1, 3)
    strands = Strands(points.astype(np.float32), np.arange(n + 1) * 6, 4e-4)
    corners = np.array([[-0.06, 0.012, -0.06], [0.06, 0.012, -0.06], [0, 0.012, 0.09]])
    head = Mesh(corners, np.array([[0, 1, 2]]))
    cameras = tuple(
        Camera.look_at(f"cam_{i}", 24, 24, (x, -0.6, 0.0), (0, 0, 0), 8.0)
        for i, x in enumerate((-0.2, 0.2, 0.05))
    )
    lights = [
        Light(f"l{i}", p, np.full(3, 5.0)) for i, p in enumerate(dome_positions(40, 1.0, -60.0))
    ]
    lights.append(Light("dark", np.array([0.0, 1.0, 0.0]), np.zeros(3)))
    rig = Rig("board", cameras, tuple(lights))
    scene = build_scene(strands, head, hair=TRUTH, skin=SKIN)
    steps = [Step(i, "olat", 0.02, level=0.5, light=x.name) for i, x in enumerate(lights)]
    plan = {"steps": [s.to_dict() for s in steps], "import": {"relative": True, "notes": []}}
    writer = CaptureWriter.create(folder / "capture", rig, plan, head=head)
    model = Model(folder / "model").create()
    model.write_strands(strands)
    for camera in cameras:
        images = render_olat(scene, camera, lights, spp=64, deep_lights=16, seed=7)
        for step, image in zip(steps, images, strict=True):
            writer.write_frame(step, camera.name, 0.5 * image)
        share = coverage(scene, camera)
        for kind, mask in (("hair", share["hair"] > 0.5), ("skin", share["head"] > 0.95)):
            model.write_mask(camera.name, kind, mask)
    writer.finish("completed", {})
    return Capture(folder / "capture"), model


@pytest.fixture(scope="module")
def fitted(made):
    capture, model = made
    report = fit(capture, model, held_out=HeldOut(("cam_2",), ("l5",)), options=OPTIONS)
    return FittedAppearance.load(model), report


def test_fit_recovers_the_appearance_that_was_rendered(fitted):
    appearance, _ = fitted
    assert appearance.hair.beta_m == pytest.approx(TRUTH.beta_m, rel=0.05)
    np.testing.assert_allclose(appearance.hair.sigma_a, TRUTH.sigma_a, rtol=0.08)  # of 200 pixels
    np.testing.assert_allclose(appearance.skin, SKIN, rtol=0.03)
    assert appearance.held_out == HeldOut(("cam_2",), ("l5",))
    assert appearance.v == pytest.approx(float(variance_of_roughness(appearance.hair.beta_m)))


def test_a_fit_leaves_no_figures_of_what_it_removes(made, tmp_path):
    capture, model = made
    other = Model(tmp_path / "model")
    shutil.copytree(model.path, other.path)
    report = Report([Stage("field", figures={"rendered": True}), Stage("head")])
    other.write_report(report)
    other.file("field.npz").write_bytes(b"of an earlier fit")
    few = replace(OPTIONS, roughness_spp=2, colour_spp=2, iterations=1, error_paths=1)
    fit(capture, other, held_out=HeldOut(("cam_2",)), options=few)
    assert not other.has("field.npz")
    names = [stage.name for stage in other.report().stages]
    assert names == ["head", "samples", "roughness", "colour"]


def test_fit_says_how_far_off_it_may_be(fitted):
    appearance, report = fitted
    low, high = appearance.beta_m_interval
    assert low < TRUTH.beta_m < high
    off = np.log(np.array(appearance.hair.sigma_a) / TRUTH.sigma_a)
    assert (np.abs(off) < np.array(appearance.sigma_a_error, float)).all()
    assert report["roughness"].figures["error"] == appearance.beta_m_error


def fit_of(folder, made, change, lights=None, cameras=("cam_0", "cam_1")):
    """What a fit makes of the frames of `made`'s subject, each of them changed.

    `change` is a `HairAppearance` to render them with, or a factor on them and the sensor's full
    scale.
    """
    capture, model = made
    lights = lights or capture.olat_lights()
    steps = [Step(i, "olat", 0.02, light=x) for i, x in enumerate(lights)]
    head = capture.head
    writer = CaptureWriter.create(
        folder / "capture", capture.rig, {"steps": [s.to_dict() for s in steps]}, head=head
    )
    scene = None
    if isinstance(change, HairAppearance):
        scene = build_scene(model.strands(), head, hair=change, skin=SKIN)
    of = [capture.rig.light(name) for name in lights]
    for name in cameras:
        camera = capture.rig.camera(name)
        if scene is None:
            images = [capture.light(x, name)[0] * change[0] for x in lights]
        else:
            images = render_olat(scene, camera, of, spp=16, deep_lights=8, seed=11, max_depth=24)
        for step, image in zip(steps, images, strict=True):
            full = np.inf if scene is not None else change[1]
            writer.write_frame(step, name, np.minimum(image, full), full_scale=full)
    writer.finish("completed", {})
    fresh = Model(folder / "model").create()
    fresh.write_strands(model.strands())
    for name in cameras:
        for kind in ("hair", "skin"):
            fresh.write_mask(name, kind, model.mask(name, kind, capture))
    left_out = tuple(c.name for c in capture.rig.cameras if c.name not in cameras)
    report = fit(Capture(folder / "capture"), fresh, held_out=HeldOut(left_out), options=OPTIONS)
    return FittedAppearance.load(fresh), report


def covers(appearance, report, beta):
    """β_M is right within a quarter or its stage warns, and the interval holds it."""
    low, high = appearance.beta_m_interval
    near = abs(np.log(appearance.hair.beta_m / beta)) < np.log(1.25)
    return (near or report["roughness"].warnings[1:]) and low / 1.1 <= beta <= high * 1.1


@pytest.mark.slow
@pytest.mark.parametrize(("beta", "rtol", "warned"), [(0.05, 0.2, 2), (0.8, 0.08, 0)])
def test_smooth_and_rough_fibres_are_found_or_warned_of(made, tmp_path, beta, rtol, warned):
    appearance, report = fit_of(tmp_path, made, HairAppearance(TRUTH.sigma_a, beta, 0.2))
    assert covers(appearance, report, beta)
    off = np.abs(np.array(appearance.hair.sigma_a) / TRUTH.sigma_a - 1)
    assert (off < rtol).all()
    assert not warned or (off < appearance.sigma_a_error).all()
    assert sum("uncertain" in w for w in report["colour"].warnings) == warned


@pytest.mark.slow
def test_white_hair(made, tmp_path):
    appearance, report = fit_of(tmp_path, made, HairAppearance((0.002, 0.003, 0.005), 0.25, 0.2))
    assert covers(appearance, report, 0.25)
    assert max(appearance.hair.sigma_a) < 0.02


@pytest.mark.slow
def test_black_hair_warns_that_its_absorption_is_unknown(made, tmp_path):
    appearance, report = fit_of(tmp_path, made, HairAppearance((6.0, 7.0, 8.0), 0.25, 0.2))
    assert min(appearance.hair.sigma_a) > 0.7
    said = report["colour"].warnings
    assert any("end of its range" in w and "beta_m" in w for w in said)


@pytest.mark.slow
def test_one_view_is_enough(made, tmp_path):
    appearance, report = fit_of(tmp_path, made, (1.0, np.inf), cameras=("cam_0",))
    assert covers(appearance, report, TRUTH.beta_m)
    np.testing.assert_allclose(appearance.hair.sigma_a, TRUTH.sigma_a, rtol=0.1)


@pytest.mark.slow
def test_a_channel_missing_from_frames_adds_no_information(made, tmp_path):
    """As of infrared frames: the next darkest channel has the roughness."""
    change = (np.array([1, 1, 0], np.float32), np.inf)
    appearance, report = fit_of(tmp_path, made, change)
    assert report["roughness"].figures["channel"] == "G"
    assert covers(appearance, report, TRUTH.beta_m)
    np.testing.assert_allclose(appearance.hair.sigma_a[:2], TRUTH.sigma_a[:2], rtol=0.08)


def test_one_light_is_refused(made, tmp_path):
    with pytest.raises(ValueError, match="needs more lights"):
        fit_of(tmp_path, made, (1.0, np.inf), lights=["l3"])


def test_frames_that_are_all_saturated_are_refused(made, tmp_path):
    with pytest.raises(ValueError, match="saturated"):
        fit_of(tmp_path, made, (1e6, 1e-3), lights=["l3", "l4", "l6"])


def test_missing_frames_and_masks_are_named(made, tmp_path):
    capture, model = made
    bare = Model(tmp_path).create()
    bare.write_strands(Strands.from_list([np.eye(3)[:2]]))
    with pytest.raises(ModelError, match="hairstage reconstruct"):
        fit(capture, bare, options=OPTIONS)
    write_strands(bare.file("strands.npz"), Strands.from_list([]))
    with pytest.raises(ValueError, match="no strands"):
        fit(capture, bare, options=OPTIONS)
    with pytest.raises(CaptureError, match="cam_9"):
        fit(capture, model, held_out=HeldOut(("cam_9",)), options=OPTIONS)
    with pytest.raises(CaptureError, match="every camera"):
        HeldOut(("cam_0", "cam_1", "cam_2")).training(capture)


def test_observations_are_responses_at_full_level(made):
    capture, model = made
    mask = model.mask("cam_0", "hair", capture)
    pixels = chosen(mask, 10, np.random.default_rng(0))
    o = observe(capture, "cam_0", ["l3", "l0"], pixels)
    full = capture.olat("cam_0", ["l3", "l0"])[0].reshape(2, -1, 3)
    np.testing.assert_array_equal(o.radiance, full[:, pixels])
    assert [x.name for x in o.lights] == ["l3", "l0"]
    assert o.valid.all()


def test_saturated_samples_are_not_valid(made, tmp_path):
    capture, _ = made
    light = capture.rig.lights[0]
    steps = [Step(0, "olat", 0.02, light=light.name)]
    writer = CaptureWriter.create(
        tmp_path / "c", capture.rig, {"steps": [s.to_dict() for s in steps]}
    )
    image = np.zeros((24, 24, 3), np.float32)
    image[0, 1] = 2.0
    writer.write_frame(steps[0], "cam_0", image, full_scale=2.0)
    writer.finish("completed", {})
    o = observe(Capture(tmp_path / "c"), "cam_0", [light.name, "l1"], np.array([0, 1]))
    assert o.valid.tolist() == [[True, False], [False, False]]


def test_appearance_file_reads_back_and_says_what_is_wrong(tmp_path):
    made = (TRUTH, (0.1, 0.2, 0.3), SKIN, Exposure(2.0), 0.1, 0.2, 0.3, LEFT_OUT)
    a = FittedAppearance(*made, 0.1, (0.2, 0.3), (0.1, 0.2, None))
    model = Model(tmp_path)
    assert not FittedAppearance.is_of(model, LEFT_OUT)
    a.save(model)
    assert FittedAppearance.load(model) == a
    assert FittedAppearance.is_of(model, HeldOut(("cam_2",), ("l7", "l5")))
    assert not FittedAppearance.is_of(model, HeldOut(("cam_2",)))
    path = tmp_path / "appearance.json"
    data = json.loads(path.read_text())
    del data["skin"]
    path.write_text(json.dumps(data))
    with pytest.raises(ValueError, match="skin"):
        FittedAppearance.load(model)
    path.unlink()
    with pytest.raises(ModelError, match="hairstage fit"):
        FittedAppearance.load(model)


def test_an_unreadable_appearance_is_fitted_again(tmp_path):
    made = (TRUTH, (0.1, 0.2, 0.3), SKIN, Exposure(2.0), 0.1, 0.2, 0.3, LEFT_OUT)
    model = Model(tmp_path)
    FittedAppearance(*made).save(model)
    (tmp_path / "appearance.json").write_text("{")
    assert not FittedAppearance.is_of(model, LEFT_OUT)


def test_an_appearance_of_an_earlier_version_renders_without_a_spread(tmp_path):
    """0.1 wrote `fibres`, the roughness of single fibres, and no spread of the rendered one."""
    made = (TRUTH, (0.1, 0.2, 0.3), SKIN, Exposure(2.0), 0.1, 0.2, 0.3, LEFT_OUT)
    model = Model(tmp_path)
    FittedAppearance(*made, 0.05, (0.2, 0.3)).save(model)
    path = tmp_path / "appearance.json"
    data = json.loads(path.read_text())
    del data["beta_m_error"], data["beta_m_interval"]
    path.write_text(json.dumps({**data, "fibres": {"beta_m": 0.2, "error": 0.1}}))
    assert FittedAppearance.load(model) == FittedAppearance(*made)


def test_strands_of_another_head_or_another_capture_are_named(made):
    capture, model = made
    own, other = Stage("samples"), Stage("samples")
    head, strands = model.head(capture), model.strands()
    moved = replace(strands, points=strands.points + np.float32([0.02, 0, 0]))
    check_strands(capture, model, build_scene(strands, head, hair=TRUTH), own, 0)
    check_strands(capture, model, build_scene(moved, head, hair=TRUTH), other, 0)
    assert own.warnings == []
    # half of a curtain 40 mm wide hangs beside its picture
    shares = other.figures["strands_outside_masks"]
    assert all(0.35 < share < 0.65 for share in shares.values())
    assert "in 3 of 3 cameras" in other.warnings[0]


def test_masks_of_another_capture_are_named(made, tmp_path):
    capture, model = made
    report = Report([Stage("masks", figures={"capture": "monday"})])
    report.save(tmp_path / "report.json")
    ours = Model(tmp_path)
    ours.write_strands(model.strands())
    for camera in capture.rig.cameras:
        ours.write_mask(camera.name, "hair", model.mask(camera.name, "hair", capture))
    scene = build_scene(model.strands(), model.head(capture), hair=TRUTH)
    for shot, expected in (("monday", 0), ("tuesday", 1)):
        again, stage = Capture(capture.path), Stage("samples")
        again.plan["started"] = shot
        check_strands(again, ours, scene, stage, 0)
        assert ["monday" in w and "tuesday" in w for w in stage.warnings] == expected * [True]
