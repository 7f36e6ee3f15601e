"""Held-out images, their baselines and the pictures, on a small capture of known appearance."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from appearance import Exposure, HairAppearance, HeldOut, Sampling, assess, build_scene, render_olat
from appearance.bsdf.maps import HairMaps
from appearance.model import assess as assessment
from appearance.model import baselines
from appearance.model.assess import front_lights, judge
from appearance.model.baselines import NearestCameras, three_nearest
from appearance.model.fitted_model import FittedModel
from appearance.model.from_frames import FromFrames, NewViews
from appearance.model.light_sums import weights_of_environment
from appearance.model.options import AssessOptions
from appearance.model.relight import relight, three_quarter_view
from appearance.model.relit_pictures import relight_model
from appearance.render.coverage import coverage
from appearance.render.environment_maps import environment_map
from appearance.render.mixed import Environment
from appearance.render.smoothed import olat_smoothed, smoothed, without_rare
from appearance.sun_fit.fitted_appearance import FittedAppearance
from reconstruction import (
    Camera,
    Capture,
    CaptureError,
    CaptureWriter,
    Light,
    Mesh,
    Model,
    ModelError,
    Rig,
    Stage,
    Step,
    Strands,
    read_exr,
)
from reconstruction.geometry.lights import dome_positions

TRUTH = HairAppearance((0.15, 0.3, 0.8), 0.2, 0.2)
HELD_OUT = HeldOut(("cam_2",), ("l4", "l7"))
OPTIONS = AssessOptions(cameras=2, lights=3, spp=64, relit_size=32, relit_spp=4)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A wisp of fibres before three cameras of 24² under 24 lights, and its model: the truth."""
    folder = tmp_path_factory.mktemp("assess")
    rng = np.random.default_rng(3)
    n = 500
    roots = np.stack(
        [rng.uniform(-0.03, 0.03, n), rng.uniform(-0.01, 0.01, n), np.full(n, 0.05)], axis=1
    )
    lean = rng.normal(scale=0.05, size=(n, 3)) * [1, 1, 0] + [0, 0, -1]
    t = np.linspace(0, 0.1, 6)
    points = (roots[:, None] + t[None, :, None] * lean[:, None]).reshape(-1, 3)
    strands = Strands(points.astype(np.float32), np.arange(n + 1) * 6, 4e-4)
    cameras = tuple(
        Camera.look_at(f"cam_{i}", 24, 24, (x, -0.6, 0.0), (0, 0, 0), 9.0)
        for i, x in enumerate((-0.2, 0.2, 0.05))
    )
    lights = tuple(
        Light(f"l{i}", p, np.full(3, 5.0)) for i, p in enumerate(dome_positions(24, 1.0, -60.0))
    )
    scene = build_scene(strands, None, hair=TRUTH)
    steps = [Step(i, "olat", 0.02, light=x.name) for i, x in enumerate(lights)]
    writer = CaptureWriter.create(
        folder / "capture", Rig("wisp", cameras, lights), {"steps": [s.to_dict() for s in steps]}
    )
    model = Model(folder / "model").create()
    model.write_strands(strands)
    bright = []
    for camera in cameras:
        images = render_olat(scene, camera, lights, spp=128, seed=7)
        for step, image in zip(steps, images, strict=True):
            writer.write_frame(step, camera.name, image)
        mask = coverage(scene, camera)["hair"] > 0.5
        bright.append(images[:, mask])
        model.write_mask(camera.name, "hair", mask)
    writer.finish("completed", {})
    exposure = Exposure.of(bright)
    FittedAppearance(TRUTH, (0.1,) * 3, (0.3,) * 3, exposure, 0.1, 0.1, 0.1, HeldOut()).save(model)
    return Capture(folder / "capture"), model, scene


@pytest.fixture
def quick(monkeypatch):
    """For tests of what is compared, not of how good it is."""
    monkeypatch.setattr(assessment, "fit_diffuse", lambda *given, **how: (0.4, 0.3, 0.2))
    return replace(OPTIONS, spp=2)


@pytest.fixture(scope="module")
def result(made):
    capture, model, _ = made
    return assess(capture, model, held_out=HELD_OUT, options=OPTIONS)


@pytest.mark.slow
def test_the_true_model_beats_the_trivial_baselines(result):
    for group in ("held_out_lights", "held_out_camera"):
        rows = result[group]
        made_of_frames = {
            "held_out_lights": {"three_nearest", "from_frames"},
            "held_out_camera": {"nearest_cameras", "three_nearest_own_frames", "from_frames"},
        }[group]
        assert set(rows) == {"ours", "mean_colour", "diffuse"} | made_of_frames
        for baseline in ("mean_colour", "diffuse"):
            assert rows["ours"]["psnr"] > rows[baseline]["psnr"] + 2
            assert rows["ours"]["ssim"] > rows[baseline]["ssim"] + 0.05
            assert rows["ours"]["relative_error"] < 0.5 * rows[baseline]["relative_error"]
    assert "HAIRSTAGE_LPIPS" in result["lpips"]


@pytest.mark.slow
def test_pictures_and_report_are_left_in_the_model(made, result):
    _, model, _ = made
    stage = model.report()["images"]
    assert stage.figures["held_out_lights"] == result["held_out_lights"]
    unbeaten = [w for w in stage.warnings if "diffuse" in w or "mean_colour" in w]
    assert not unbeaten
    comparison = cv2.imread(str(model.file("comparison.png")))
    assert comparison.shape[1] > comparison.shape[0] / 2 > 200
    assert not model.work("images").exists()


def test_a_baseline_that_is_not_beaten_is_warned_of():
    stage = Stage("images")
    good, bad = {"psnr": 20.0, "ssim": 0.5}, {"psnr": 10.0, "ssim": 0.6}
    rows = {"ours": good, "sun_fit": good, "three_nearest": bad, "diffuse": good}
    judge({"held_out_camera": {**rows, "three_nearest_own_frames": good}}, stage)
    assert [w.split("baseline ")[1] for w in stage.warnings] == [
        "three_nearest is not beaten in ssim: 0.5 against its 0.6",
        "diffuse is not beaten in psnr: 20 dB against its 20",
        "diffuse is not beaten in ssim: 0.5 against its 0.5",
    ]


def test_if_every_held_out_frame_is_black_nothing_is_compared(made, quick, tmp_path, monkeypatch):
    capture, model, _ = made
    other = Model(tmp_path / "model")
    shutil.copytree(model.path, other.path)
    other.file("comparison.png").write_bytes(b"of an earlier fit")
    of_light = Capture.light

    def black(self, name, camera):
        image, saturated = of_light(self, name, camera)
        return (0 * image if name == "l4" else image), saturated

    monkeypatch.setattr(Capture, "light", black)
    found = assess(capture, other, held_out=HeldOut((), ("l4",)), options=quick)
    assert set(found) == {"lpips", "rendered"}
    warnings = other.report()["images"].warnings
    assert sum("black or saturated" in w for w in warnings) == 2
    assert "nothing is compared" in warnings[-1]
    assert not other.has("comparison.png")


def test_a_camera_that_meets_no_strand_leaves_out_the_baseline_on_strands(
    made, quick, tmp_path, monkeypatch
):
    capture, model, _ = made
    other = Model(tmp_path / "model")
    shutil.copytree(model.path, other.path)
    first_hits = baselines.first_hits

    def hits(scene, camera, mask):
        points, met = first_hits(scene, camera, mask)
        return points, met & (camera.name != "cam_2")

    monkeypatch.setattr(baselines, "first_hits", hits)
    held_out = HeldOut(("cam_1", "cam_2"))
    found = assess(capture, other, held_out=held_out, options=quick)
    rows = set(found["held_out_camera"])
    assert rows == {"ours", "mean_colour", "diffuse", "three_nearest_own_frames"}


def test_without_held_out_frames_a_warning_is_all(made, tmp_path):
    capture, model, _ = made
    copy = Model(tmp_path / "copy")
    shutil.copytree(model.path, copy.path)
    for name in ("comparison.png", "report.json"):
        copy.remove(name)
    assert set(assess(capture, copy, held_out=HeldOut(), options=OPTIONS)) <= {"lpips"}
    assert not copy.has("comparison.png")
    assert "nothing is compared" in copy.report()["images"].warnings[0]


def test_a_model_is_relit_without_what_an_earlier_relighting_left(made, tmp_path):
    capture, model, _ = made
    copy = Model(tmp_path / "copy")
    shutil.copytree(model.path, copy.path)
    copy.file("relit.webp").touch()
    relight_model(capture, copy, options=OPTIONS)
    relit, _ = read_exr(copy.file("relit.exr"))
    picture = cv2.imread(str(copy.file("relit.png")))
    assert picture.shape == relit.shape == (32, 32, 3)
    assert (relit > 0).any()
    assert picture.max() == 255
    assert not copy.has("relit.webp")
    assert copy.report()["relighting"].seconds > 0


def test_three_nearest_lights_are_training_lights(made):
    capture, _, _ = made
    light = capture.rig.light("l4")
    training = HELD_OUT.training(capture).olat_lights()
    mixed = three_nearest(capture, "cam_0", light, training)
    positions = {x.name: x.position @ light.position for x in capture.rig.lights}
    nearest = sorted(set(positions) - {"l4", "l7"}, key=lambda n: -positions[n])[:3]
    frames, _ = capture.olat("cam_0", nearest)
    weights = 1 / np.arccos([positions[n] for n in nearest])
    want = np.tensordot(weights / weights.sum(), frames, 1)
    np.testing.assert_allclose(mixed, want, rtol=1e-5)


@pytest.fixture
def faulty(tmp_path):
    """Frames of ones under four lamps, of which "off" gives no light and "red" no other colour.

    The camera "dead" has no frame.
    """
    watts = {"off": (0, 0, 0), "red": (1, 0, 0), "l0": (1, 1, 1), "l1": (1, 1, 1)}
    places = [(0.05, -1, 0), (0, -1, 0.1), (0.2, -1, 0), (-0.2, -1, 0)]
    lights = tuple(
        Light(name, np.array(p, float) / np.linalg.norm(p), np.array(w, float))
        for (name, w), p in zip(watts.items(), places, strict=True)
    )
    cameras = tuple(
        Camera.look_at(name, 8, 8, (x, -1, 0.1), (0, 0, 0), 10.0)
        for name, x in (("alive", -0.5), ("dead", 0.1), ("new", 0.0))
    )
    steps = [Step(i, "olat", 0.02, light=x.name) for i, x in enumerate(lights)]
    writer = CaptureWriter.create(
        tmp_path / "c", Rig("r", cameras, lights), {"steps": [s.to_dict() for s in steps]}
    )
    rng = np.random.default_rng(0)
    for step, light in zip(steps, lights, strict=True):
        frame = light.intensity + 1e-3 * rng.normal(size=(8, 8, 3))
        writer.write_frame(step, "alive", frame.astype(np.float32))
        for name in ("dead", "new"):
            writer.record_missing(step, name, reason="none")
    writer.finish("completed", {})
    return Capture(tmp_path / "c")


def test_lamps_that_give_no_light_stand_for_none(small, faulty, tmp_path):
    """Divided by nothing, their frames' noise was a thousand million times the picture."""
    light = Light("new", np.array([0.02, -1, 0.0]), np.ones(3))
    training = faulty.olat_lights()
    mixed = three_nearest(faulty, "alive", light, training)
    np.testing.assert_allclose(mixed, 1, rtol=0.05)
    with pytest.raises(ValueError, match="alive: the capture has no frame of it"):
        three_nearest(faulty, "alive", light, ["off"])
    strands = small.tuft(300)
    model = Model(tmp_path / "model").create()
    model.write_strands(strands)
    skin = (0.3, 0.3, 0.3)
    FittedAppearance(TRUTH, skin, skin, Exposure(1.0), 0.1, 0.1, 0.1, HeldOut()).save(model)
    for name in ("alive", "dead", "new"):
        model.write_mask(name, "hair", np.ones((8, 8), bool))
    frames = FromFrames.of(FittedModel.load(model, faulty), model, faulty)
    alive, dead = (frames.view(faulty.rig.camera(n)) for n in ("alive", "dead"))
    image, unseen = frames.relit(alive, [light], np.zeros((8, 8, 3)))
    assert unseen == 0
    assert np.abs(image).max() < 10
    with pytest.raises(ModelError, match="dead: all of its frames are missing"):
        frames.relit(dead, [light], np.zeros((8, 8, 3)))


def test_a_camera_without_frames_is_no_neighbour(small, faulty):
    scene = build_scene(small.tuft(300), None, hair=TRUTH)
    rest = faulty.view(cameras=["alive", "dead"])
    view = NearestCameras.of(rest, faulty.rig.camera("new"), scene, np.ones((8, 8), bool))
    assert view is not None
    assert view.names == ("alive",)
    assert np.isfinite(view(faulty.rig.light("l0"))).all()
    alone = faulty.view(cameras=["dead"])
    new = faulty.rig.camera("new")
    assert NearestCameras.of(alone, new, scene, np.ones((8, 8), bool)) is None


@pytest.fixture(scope="module")
def frames(made):
    capture, model, _ = made
    return FromFrames.of(FittedModel.load(model, capture), model, HELD_OUT.training(capture))


@pytest.mark.slow
def test_frames_changed_by_the_true_model_are_nearer_than_unchanged_ones(result):
    rows = result["held_out_lights"]
    assert rows["from_frames"]["psnr"] > rows["three_nearest"]["psnr"] + 0.5


def test_relit_frames_of_a_captured_light_are_its_own(made, frames):
    """Also under a light there of another intensity; what is no hair stays the picture's."""
    capture, model, _ = made
    light, view = capture.rig.light("l0"), frames.view(capture.rig.camera("cam_0"))
    frame, _ = capture.light("l0", "cam_0")
    mask = model.mask("cam_0", "hair", capture)
    base = np.full(frame.shape, 7.0, np.float32)
    brighter = Light("other", light.position, 3 * light.intensity)
    for lit, gain in (([light], 1), ([brighter], 3), ([light, brighter], 4)):
        image, _ = frames.relit(view, lit, base)
        np.testing.assert_allclose(image[mask], gain * frame[mask], 2e-3, 1e-5)
        assert (image[~mask] == 7).all()


def test_an_environment_relights_frames_as_the_sum_of_its_lights(made, frames):
    """Where each direction's nearest light has its irradiance: the sum of frames at weights."""
    capture, model, _ = made
    envmap = environment_map("studio")
    lights = [x for x in capture.rig.lights if x.name not in HELD_OUT.lights]
    weights = weights_of_environment(lights, envmap)
    want = sum(w * capture.light(x.name, "cam_0")[0] for w, x in zip(weights, lights, strict=True))
    mask = model.mask("cam_0", "hair", capture)
    lit = frames.lights_of([Environment(envmap)])
    view = frames.view(capture.rig.camera("cam_0"))
    image, _ = frames.relit(view, lit, np.zeros(want.shape))
    np.testing.assert_allclose(image[mask], want[mask], rtol=5e-3, atol=1e-5)


def test_a_new_view_is_nearer_to_its_frame_than_a_model_of_a_wrong_colour(made):
    """The frames of both other cameras correct twice the absorption."""
    capture, model, _ = made
    fitted = FittedModel.load(model, capture)
    hair = replace(TRUTH, sigma_a=tuple(2 * x for x in TRUTH.sigma_a))
    fitted = fitted.with_maps(HairMaps.of(hair))
    frames = FromFrames.of(fitted, model, HELD_OUT.training(capture))
    camera = capture.rig.camera("cam_2")
    lights = [x for x in capture.rig.lights if capture.light(x.name, "cam_2")[0].mean() > 0.01]
    lights = lights[:: max(len(lights) // 4, 1)]
    rendered = {
        c.name: olat_smoothed(frames.scene, c, lights, Sampling(64)) for c in capture.rig.cameras
    }
    relit = NewViews.of(frames, [[light] for light in lights], rendered)
    mask = model.mask("cam_2", "hair", capture)
    levels = []
    for k, light in enumerate(lights):
        image, unseen = relit(camera, rendered["cam_2"][k], k)
        pictures = capture.light(light.name, "cam_2")[0], rendered["cam_2"][k], image
        levels.append([x[mask].mean() for x in pictures])
        assert unseen < 0.1
    truth, before, after = np.array(levels).T
    errors = [np.median(np.abs(x / truth - 1)) for x in (before, after)]
    assert errors[1] < 0.6 * errors[0], errors
    behind = Camera.look_at("behind", 24, 24, (0, 0.6, 0.0), (0, 0, 0), 9.0)
    with pytest.raises(ValueError, match="behind: no captured camera sees the hair"):
        relit(behind, olat_smoothed(frames.scene, behind, lights[:1], Sampling(4))[0])


def test_frames_of_another_exposure_and_captures_without_lights_are_refused(made):
    capture, model, _ = made
    fitted = FittedModel.load(model, capture)
    darker = replace(fitted.appearance, exposure=Exposure(20 * fitted.appearance.exposure.scale))
    with pytest.raises(CaptureError, match="times as bright as that which"):
        FromFrames.of(replace(fitted, appearance=darker), model, capture)
    with pytest.raises(CaptureError, match="no frames under single lights"):
        FromFrames.of(fitted, model, capture.without_lights(capture.olat_lights()))


def test_a_saturated_pixel_is_mixed_of_the_lights_that_do_not_saturate_it(tmp_path):
    """Three equal lights about a fourth; under one of them a pixel is at full scale."""
    cameras = tuple(
        Camera.look_at(f"cam_{i}", 4, 4, (i - 0.5, -1, 0), (0, 0, 0), 10.0) for i in range(2)
    )
    places = [(0, -1, 0.1), (0.1, -1, 0), (-0.1, -1, 0)]
    lights = tuple(Light(f"l{i}", np.array(p), np.ones(3)) for i, p in enumerate(places))
    steps = [Step(i, "olat", 0.02, light=x.name) for i, x in enumerate(lights)]
    rig = Rig("r", cameras, (*lights, Light("new", np.array((0.0, -1.005, 0)), np.ones(3))))
    writer = CaptureWriter.create(tmp_path / "c", rig, {"steps": steps})
    for step, value in zip(steps, (1.0, 2.0, 3.0), strict=True):
        image = np.full((4, 4, 3), value, np.float32)
        image[0, 0] = 4.0 if step.index == 0 else value
        writer.write_frame(step, "cam_0", image, full_scale=4.0)
        writer.record_missing(step, "cam_1", reason="none")
    writer.finish("completed", {})
    mixed = three_nearest(Capture(tmp_path / "c"), "cam_0", rig.light("new"), ["l0", "l1", "l2"])
    np.testing.assert_allclose(mixed[1:], 2.0, rtol=0.02)
    np.testing.assert_allclose(mixed[0, 0], 2.5, rtol=0.02)


def test_lights_to_show_stand_before_the_camera_and_apart():
    camera = Camera.look_at("cam", 8, 8, (0, -1, 0), (0, 0, 0), 10.0)
    angles = {"behind": 180, "above": 60, "near": 10, "left": -80, "beside": 15, "rear": 100}
    lights = [
        Light(name, (np.sin(np.radians(a)), -np.cos(np.radians(a)), 0), np.ones(3))
        for name, a in angles.items()
    ]
    middle = np.zeros(3)
    shown = front_lights(camera, lights, middle, 3)
    assert [(lights[k].name, round(angle)) for k, angle in shown] == [
        ("near", 10),
        ("left", 80),
        ("above", 60),
    ]
    assert len(front_lights(camera, lights, middle, 9)) == 4
    ((only, angle),) = front_lights(camera, [lights[0], lights[5]], middle, 3)
    assert (only, round(angle)) == (1, 100)


def test_other_cameras_show_a_pattern_on_a_surface_where_it_is(tmp_path):
    # a plane that faces the cameras, with brightness x + 2z at every point: what any camera must
    # read at a pixel follows from where its ray meets the plane
    plane = Mesh(
        np.array([[-0.2, 0, -0.2], [0.2, 0, -0.2], [0.2, 0, 0.2], [-0.2, 0, 0.2]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
    )
    cameras = tuple(
        Camera.look_at(f"cam_{i}", 32, 32, (x, -0.6, 0.05), (0, 0, 0), 12.0)
        for i, x in enumerate((-0.3, 0.25, 0.0))
    )
    light = Light("l", np.array([0.0, -1.0, 0.0]), np.ones(3))
    step = Step(0, "olat", 0.02, light="l")
    writer = CaptureWriter.create(
        tmp_path, Rig("plane", cameras, (light,)), {"steps": [step.to_dict()]}
    )
    frames = {}
    for camera in cameras:
        pixels = np.stack(np.meshgrid(np.arange(32), np.arange(32)), axis=-1)
        rays = camera.rays(pixels)
        where = camera.center - rays * (camera.center[1] / rays[..., 1])[..., None]
        value = 1 + where[..., 0] + 2 * where[..., 2]
        frames[camera.name] = np.repeat(value[..., None], 3, axis=-1).astype(np.float32)
        writer.write_frame(step, camera.name, frames[camera.name])
    writer.finish("completed", {})
    training = Capture(tmp_path).view(cameras=["cam_0", "cam_1"])
    scene = build_scene(Strands.from_list([]), plane, hair=TRUTH)
    view = NearestCameras.of(training, cameras[2], scene, np.zeros((32, 32), bool))
    found = view(light)[2:-2, 2:-2]
    np.testing.assert_allclose(found, frames["cam_2"][2:-2, 2:-2], atol=2e-3)


def test_smoothing_keeps_the_mean_and_takes_the_noise(made):
    capture, _, scene = made
    camera, lights = capture.rig.cameras[0], capture.rig.lights
    mask = coverage(scene, camera)["hair"] > 0.5
    reference = capture.olat("cam_0", [x.name for x in lights])[0][:, mask]
    plain = render_olat(scene, camera, lights, spp=9, thrift=0, seed=3)[:, mask]
    smooth = olat_smoothed(scene, camera, lights, Sampling(9, 16, 3))[:, mask]
    # light is handed on by share of the pixels, so that a little crosses the mask's edge
    assert smooth.mean() == pytest.approx(reference.mean(), rel=0.05)
    error = [np.sqrt(np.mean((x - reference) ** 2)) for x in (plain, smooth)]
    assert error[1] < 0.6 * error[0]


def test_few_pixels_have_the_light_that_many_paths_find_with_less_noise(made):
    """Among few pixels there is nothing to smooth: they get more paths."""
    capture, _, scene = made
    camera, lights = capture.rig.cameras[0], capture.rig.lights
    hair = np.flatnonzero(coverage(scene, camera)["hair"] > 0.5)
    few = hair[:: -(-len(hair) // 6)]
    reference, plain = (
        render_olat(scene, camera, lights, spp=spp, seed=spp, pixels=few) for spp in (2048, 9)
    )
    found = olat_smoothed(scene, camera, lights, Sampling(9, 16, 3), pixels=few)
    error = [np.sqrt(np.mean((x - reference) ** 2)) for x in (plain, found)]
    assert error[1] < 0.5 * error[0]


def test_few_paths_bring_direct_light_as_many_do(made):
    capture, _, scene = made
    camera, lights = capture.rig.cameras[0], [capture.rig.light("l4")]
    mask = coverage(scene, camera)["hair"] > 0.5
    reference, many = (
        render_olat(scene, camera, lights, spp=spp, max_depth=1, seed=spp)[0][mask]
        for spp in (576, 36)
    )
    few = olat_smoothed(scene, camera, lights, Sampling(4, 1, 3))[0][mask]
    assert np.mean((few - reference) ** 2) < 0.8 * np.mean((many - reference) ** 2)


def test_smoothing_does_not_cross_from_hair_to_head():
    share = {k: np.zeros((16, 16), np.float32) for k in ("hair", "head")}
    share["hair"][:, :8], share["head"][:, 8:] = 1, 1
    images = np.zeros((1, 16, 16, 3), np.float32)
    images[:, :, :8] = 2.0
    out = smoothed(images, share, 1.5)
    np.testing.assert_allclose(out, images, rtol=1e-5)
    with pytest.raises(ValueError, match="sigma"):
        smoothed(images, share, 0.0)


def test_smoothing_leaves_no_blot_where_a_rare_path_hit():
    share = {"hair": np.ones((33, 33), np.float32), "head": np.zeros((33, 33), np.float32)}
    images = np.ones((1, 33, 33, 3), np.float32)
    images[0, 16, 16] = 400.0
    out = smoothed(images, share, 1.0)[0, ..., 0]
    assert out.max() < 0.2 * 400 / (2 * np.pi)  # a blot of one Gaussian would peak at 64
    assert out.sum() == pytest.approx(images[0, ..., 0].sum(), rel=0.1)


def test_a_rare_path_is_spread_and_a_glint_along_a_strand_stays():
    rng = np.random.default_rng(0)
    share = {"hair": np.ones((48, 48), np.float32), "head": np.zeros((48, 48), np.float32)}
    glint = np.ones((48, 48, 3))
    glint[8:20, 12] = 5.0  # a strand, one pixel wide
    one, other = (glint + rng.normal(scale=0.02, size=glint.shape) for _ in range(2))
    one[32, 32] = 41.0  # a path that the other picture has not met
    found = without_rare(one.astype(np.float32), other.astype(np.float32), share, 3.0)
    np.testing.assert_allclose(found[9:19, 12], 5.0, atol=0.15)
    assert found[32, 32].max() < 1.5  # the mean would be 21
    assert found.sum() == pytest.approx((0.5 * (one + other)).sum(), rel=0.005)


def test_relighting_names_and_views():
    strands = Strands.from_list([np.array([[0, 0, 0.1], [0, 0.1, 0], [0.1, 0, 0]])])
    view = three_quarter_view(strands, 64)
    pixels, depth = view.project(strands.points)
    assert view.inside(pixels).all()
    assert (depth > 0).all()
    for shape in ((0.09, 0.09, 0.6), (0.0, 0.0, 0.9), (0.5, 0.5, 0.01)):  # long, one hair, flat
        around = np.random.default_rng(0).normal(size=(200, 3))
        around = around / np.linalg.norm(around, axis=1, keepdims=True) * shape
        for turned in range(0, 360, 45):
            view = three_quarter_view(Strands.from_list([around]), 64, turned)
            assert view.inside(view.project(around)[0]).all()
    still = Strands.from_list([np.full((2, 3), 0.1)])
    np.testing.assert_allclose(three_quarter_view(still, 64).project(still.points)[0], 31.5)
    with pytest.raises(ValueError, match="no strands to see"):
        three_quarter_view(Strands.from_list([]), 64)
    with pytest.raises((ValueError, FileNotFoundError), match="nowhere"):
        environment_map("nowhere.hdr")


@pytest.mark.parametrize(("strands", "level"), [(3, 1.0), (300, 0.0)])
def test_sparse_hair_and_a_black_room_are_relit(small, tmp_path, strands, level):
    """Three strands fill half of no pixel; a black room lights none."""
    hair, skin = HairAppearance((0.1, 0.1, 0.1), 0.3, 0.3), (0.3, 0.3, 0.3)
    model = Model(tmp_path / "model").create()
    model.write_strands(replace(small.tuft(strands), radius=4e-5))
    FittedAppearance(hair, skin, skin, Exposure(1.0), 0.1, 0.1, 0.1, HeldOut()).save(model)
    image = relight(FittedModel.load(model), model, np.full((2, 4, 3), level), size=64, spp=4)
    shown = cv2.imread(str(model.file("relit.png")))
    assert (image.max() > 0) == (level > 0)
    assert (shown.max() == 255) == (level > 0)
