"""A field of a capture: kept where held-out pictures are better with it, in every picture then."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

from appearance import (
    Environment,
    Exposure,
    FieldRequest,
    FittedModel,
    HairAppearance,
    HeldOut,
    Sampling,
    fit_field_validated,
    render_olat,
)
from appearance.fields import pipeline
from appearance.fields.options import FieldOptions
from appearance.metrics.decision import Decision
from appearance.model import fitted_field
from appearance.model.edit import cut, restyled
from appearance.render.coverage import coverage
from appearance.sun_fit.fitted_appearance import FittedAppearance
from reconstruction import (
    Camera,
    Capture,
    CaptureWriter,
    Light,
    Model,
    ModelError,
    Rig,
    Step,
    Strands,
)
from reconstruction.geometry.lights import dome_positions

WORSE = Decision("field", 0.04, 0.05, 0.001)
HAIR = HairAppearance((0.2, 0.2, 0.2), 0.3, 0.3)
REQUEST = FieldRequest(
    lights=12,
    pixels=20_000,
    spp=1024,
    max_depth=2,
    fit=FieldOptions(degree=1, levels=((2, 3, 3),), ridges=(1e-3, 1e-2, 0.1)),
)


@pytest.fixture(scope="module")
def made(small, tmp_path_factory):
    """Frames of one hair that is twice as bright to the red as the model has it, on its strands."""
    folder = tmp_path_factory.mktemp("field")
    angles = np.arange(4) * np.pi / 2
    cameras = tuple(
        Camera.look_at(f"c{k}", 14, 14, (0.5 * np.cos(a), 0.5 * np.sin(a), 0.1), (0, 0, 0), 12)
        for k, a in enumerate(angles)
    )
    lights = tuple(
        Light(f"l{i}", p, np.full(3, 5.0)) for i, p in enumerate(dome_positions(12, 1.0))
    )
    strands = small.tuft(300)
    model = Model(folder / "model").create()
    model.write_strands(strands)
    skin = (0.3, 0.3, 0.3)
    FittedAppearance(HAIR, skin, skin, Exposure(3.0), 0.1, 0.1, 0.1, HeldOut()).save(model)
    scene = FittedModel.load(model).scene()
    steps = [Step(i, "olat", 0.02, light=x.name) for i, x in enumerate(lights)]
    writer = CaptureWriter.create(
        folder / "capture", Rig("tuft", cameras, lights), {"steps": [s.to_dict() for s in steps]}
    )
    for camera in cameras:
        mask = coverage(scene, camera)["hair"] > 0.6
        model.write_mask(camera.name, "hair", mask)
        frames = render_olat(scene, camera, lights, spp=1024, max_depth=2, seed=9)
        for step, image in zip(steps, frames, strict=True):
            shown = (image * (2.0, 1.0, 1.0)).astype(np.float32)
            writer.write_frame(step, camera.name, shown)
    writer.finish("completed", {})
    return Capture(folder / "capture"), model


@pytest.fixture
def own(made, tmp_path):
    capture, model = made
    shutil.copytree(model.path, tmp_path / "model")
    return capture, Model(tmp_path / "model")


@pytest.fixture(scope="module")
def kept(made, tmp_path_factory):
    """The model with a field that was kept, what the fit returned, and its progress."""
    capture, model = made
    copy, shares = Model(tmp_path_factory.mktemp("kept") / "model"), []
    shutil.copytree(model.path, copy.path)
    result = fit_field_validated(
        capture, copy, request=REQUEST, progress=lambda what, share: shares.append(share)
    )
    return copy, result, shares


@pytest.mark.slow
def test_a_field_that_helps_is_in_every_picture_of_the_model(made, kept):
    capture, (model, result, shares) = made[0], kept
    assert shares == sorted(shares)
    assert result["rendered"]
    (decision,) = result["stages"]
    assert decision["after"] < 0.9 * decision["before"]
    fitted = FittedModel.load(model, capture)
    bare = fitted.without_field()
    camera, light = capture.rig.camera("c1"), capture.rig.light("l5")
    sky = Environment(np.ones((2, 4, 3), np.float32))
    for lights, maps in (([light], []), ([], [sky])):
        with_it, without = (
            m.render(camera, lights, maps, Sampling(1024, 2))[5:10, 5:10].sum((0, 1))
            for m in (fitted, bare)
        )
        assert with_it[0] / without[0] == pytest.approx(2, rel=0.08)
        assert with_it[1] / without[1] == pytest.approx(1, rel=0.08)
    assert not model.work("field").exists()
    assert FittedModel.load(model, capture, with_field=False).field is None


def test_lights_and_pixels_follow_from_the_unknowns():
    """Four harmonics, twice in each of three folds, and at 8 x 32 x 32 anchors over the cameras."""
    assert FieldRequest().resolved(8, 10_000) == (24, 4096)
    assert FieldRequest().resolved(48, 10_000) == (24, 683)
    on_strands = FieldOptions(levels=((2, 4, 4), (8, 0, 0)), degree=3)
    assert FieldRequest(fit=on_strands, lights=7).resolved(10, 500) == (7, 6400)


@pytest.mark.slow
def test_edited_hair_keeps_its_field(made, kept, tmp_path):
    capture, model = made[0], Model(tmp_path / "model")
    shutil.copytree(kept[0].path, model.path)
    fitted = FittedModel.load(model, capture)
    order = np.random.default_rng(0).permutation(300)
    strands = [fitted.strands.points[8 * k : 8 * k + 8] for k in order]
    shuffled = restyled(fitted, Strands.from_list(strands, radius=4e-4))
    camera, light = capture.rig.camera("c0"), [capture.rig.light("l3")]
    pictures = [
        m.render(camera, light, [], Sampling(1024, 2)).sum((0, 1)) for m in (fitted, shuffled)
    ]
    np.testing.assert_allclose(pictures[1], pictures[0], rtol=0.02)
    short = cut(fitted, 0.03)
    short.save(Model(tmp_path / "short"))
    again = FittedModel.load(Model(tmp_path / "short"))
    np.testing.assert_allclose(again.field.places.kept, short.field.places.kept, rtol=1e-6)
    bare = again.without_field()
    one, other = (m.render(camera, light, [], Sampling(1024, 2)).sum((0, 1)) for m in (again, bare))
    # what lay hidden below is less well known
    assert (one[0] / one[1]) / (other[0] / other[1]) == pytest.approx(2, rel=0.15)
    model.write_strands(Strands.from_list(strands[:10], radius=4e-4))
    fitted.appearance.save(model)
    fitted.field.save(model)
    with pytest.raises(ModelError, match=r"is of 300 strands and strands\.npz holds 10"):
        FittedModel.load(model)


def test_a_field_that_makes_pictures_worse_is_not_rendered(own, monkeypatch):
    capture, model = own
    fit = fitted_field.fit_field

    def worse(*args):
        return replace(fit(*args), decision=WORSE)

    monkeypatch.setattr(fitted_field, "fit_field", worse)
    result = fit_field_validated(capture, model, request=replace(REQUEST, spp=32))
    assert not result["rendered"]
    assert FittedModel.load(model, capture).field is None


@pytest.mark.slow
def test_an_earlier_field_stays_until_a_better_one_or_none_replaces_it(own, monkeypatch):
    capture, model = own
    right, found = fitted_field.fit_field, []

    def kept(*args):
        found.append(right(*args))
        return found[-1]

    def killed(*args):
        raise KeyboardInterrupt

    def doubted(*args):
        return replace(found[0], decision=WORSE)

    monkeypatch.setattr(fitted_field, "fit_field", kept)
    assert fit_field_validated(capture, model, request=REQUEST)["rendered"]
    was, report = model.file("field.npz").read_bytes(), model.report().to_dict()
    monkeypatch.setattr(fitted_field, "fit_field", killed)
    with pytest.raises(KeyboardInterrupt):
        fit_field_validated(capture, model, request=REQUEST)
    assert model.file("field.npz").read_bytes() == was
    assert model.report().to_dict() == report
    monkeypatch.setattr(fitted_field, "fit_field", doubted)
    assert not fit_field_validated(capture, model, request=REQUEST)["rendered"]
    assert model.file("field.npz").read_bytes() == was
    fit_field_validated(capture, model, request=FieldRequest("none"))
    assert not model.has("field.npz")
    assert "field" not in [stage.name for stage in model.report().stages]


def test_a_field_to_one_camera_and_three_lights_is_skipped(own):
    capture, model = own
    few = capture.view(cameras=["c0"], lights=["l0", "l5", "l9"])
    result = fit_field_validated(few, model, request=REQUEST)
    assert not result["rendered"]
    assert "no frame can be held out" in result["stages"][0]["skipped"]
    assert not model.has("field.npz")


@pytest.mark.slow
def test_a_killed_fit_renders_no_view_twice_and_memory_is_refused(own, monkeypatch):
    capture, model = own

    def killed(what, share):
        if what.startswith("c2"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_field_validated(capture, model, request=REQUEST, progress=killed)
    rendered = []
    smoothed = pipeline.olat_smoothed

    def counted(scene, camera, *args, **more):
        rendered.append(camera.name)
        return smoothed(scene, camera, *args, **more)

    monkeypatch.setattr(pipeline, "olat_smoothed", counted)
    fit_field_validated(capture, model, request=REQUEST)
    assert rendered == ["c2", "c2", "c3", "c3"], "two halves each"
    monkeypatch.setattr(pipeline, "free_memory", lambda: 1e-4)
    with pytest.raises(ModelError, match=r"GB of memory"):
        fit_field_validated(capture, model, request=REQUEST)
