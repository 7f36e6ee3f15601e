"""`fit`, `render`, `edit` and `export` on a tuft of which one half is nearly black."""

from __future__ import annotations

import copy
import json
import shutil
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import appearance
from appearance import FittedModel, HairAppearance, build_scene, render_olat
from appearance.bsdf.maps import HairMaps, MappedStrands, scalp_coordinates
from appearance.export.groom import at_points
from appearance.fields.field import Field
from appearance.render.coverage import coverage
from reconstruction import (
    Camera,
    Capture,
    CaptureWriter,
    Light,
    Mesh,
    Model,
    Rig,
    Step,
    Strands,
    read_exr,
    read_strands,
    write_obj,
    write_strands,
)
from reconstruction.geometry.lights import dome_positions
from stage_service.cli import main
from stage_service.jobs import steps

HAIR = HairAppearance((0.1, 0.1, 0.1), 0.25, 0.2)
DEPTH = 5
UNSEEN = "l12"
INVERSE = {
    "hair_pixels": 150,
    "max_depth": DEPTH,
    "fit": {"shape": [1, 4, 4], "effort": {"pixels": 80, "spp": 16}},
}


def tuft(count: int, seed: int = 0) -> Strands:
    rng = np.random.default_rng(seed)
    angle, r = rng.uniform(0, 2 * np.pi, count), 0.02 * np.sqrt(rng.uniform(size=count))
    root = np.stack([r * np.cos(angle), r * np.sin(angle), np.full(count, -0.03)], -1)
    bend = rng.normal(scale=0.002, size=(count, 1, 3))
    t = np.linspace(0, 1, 6)[:, None]
    points = root[:, None] + bend * t**2 + 0.06 * t * np.array([0, 0, 1.0])
    return Strands(points.reshape(-1, 3).astype(np.float32), 6 * np.arange(count + 1), 4e-4)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The capture, and a model with strands and masks alone."""
    folder = tmp_path_factory.mktemp("tuft")
    strands = tuft(200)
    uv = scalp_coordinates(strands, None)
    sigma_a = np.broadcast_to((0.05, 0.1, 0.2), (1, 4, 4, 3)).copy()
    sigma_a[0, :2] = (0.8, 1.5, 2.5)
    truth = HairMaps(sigma_a, np.zeros((1, 4, 4, 2)), HAIR.beta_m, HAIR.beta_n)
    scene = build_scene(strands, None, hair=HAIR)
    scene = MappedStrands.of(scene, strands, uv).with_maps(truth)
    cameras = tuple(
        Camera.look_at(f"cam_{i}", 20, 20, (x, y, 0.05), (0, 0, 0), 7.0)
        for i, (x, y) in enumerate(((0.0, -0.6), (0.3, 0.5)))
    )
    lights = tuple(
        Light(f"l{i}", p, np.full(3, 5.0)) for i, p in enumerate(dome_positions(24, 1.0, -60.0))
    )
    steps = [Step(i, "olat", 0.02, light=x.name) for i, x in enumerate(lights) if x.name != UNSEEN]
    writer = CaptureWriter.create(
        folder / "capture", Rig("tuft", cameras, lights), {"steps": [s.to_dict() for s in steps]}
    )
    model = Model(folder / "model").create()
    model.write_strands(strands)
    for camera in cameras:
        images = render_olat(scene, camera, lights, spp=128, max_depth=DEPTH, seed=7)
        for step in steps:
            image = images[int(step.light[1:])]
            writer.write_frame(step, camera.name, image)
        model.write_mask(camera.name, "hair", coverage(scene, camera)["hair"] > 0.5)
    writer.finish("completed", {})
    unseen = images[int(UNSEEN[1:])]
    return SimpleNamespace(capture=folder / "capture", model=model, folder=folder, unseen=unseen)


def error_of_render(made, capsys) -> float:
    """The relative error of `hairstage render` against a frame that no fit has seen."""
    out = made.folder / "render.exr"
    words = ["render", made.model, "--capture", made.capture, "--camera", "cam_1", "--json"]
    assert main([str(w) for w in (*words, "--light", UNSEEN, "--spp", 64, "--out", out)]) == 0
    assert json.loads(capsys.readouterr().out)["lights"] == [UNSEEN]
    capture = Capture(made.capture)
    mask = made.model.mask("cam_1", "hair", capture)
    truth = made.unseen[mask]
    return float(np.linalg.norm(read_exr(out)[0][mask] - truth) / np.linalg.norm(truth))


@pytest.fixture(scope="module")
def fitted(made):
    """What `hairstage fit` printed; the model of `made` then has maps and lights."""
    options = json.dumps({"inverse_rendering": INVERSE, "fit": {"error_paths": 10_000}})
    words = ["fit", made.capture, made.model, "--stages", "sun,spatial", "--options", options]
    with redirect_stdout(StringIO()) as printed:
        assert main([*map(str, words), "--json"]) == 0
    return json.loads(printed.getvalue())


@pytest.mark.slow
def test_a_render_of_fitted_maps_is_nearer_to_a_held_out_frame(made, fitted, capsys):
    """Sun's fit leaves one material for all hair."""
    found = fitted
    assert found["appearance"] == made.model.json("appearance.json")
    assert [x["stage"] for x in found["stages"]] == ["shared", "spatial"]
    assert found["inverse_rendering"]["kept"][-1] == "spatial"
    assert len(made.model.json("lights.json")) == 16  # of 23: twelve are fitted, four decide
    mapped = error_of_render(made, capsys)
    with_maps = made.model.arrays("hair_maps.npz")
    made.model.remove("hair_maps.npz")
    one_material = error_of_render(made, capsys)
    made.model.write_arrays("hair_maps.npz", with_maps)
    assert mapped < 0.7 * one_material


def run(capsys, *words) -> tuple[int, dict]:
    code = main([*map(str, words), "--json"])
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.usefixtures("fitted")
@pytest.mark.parametrize(
    ("words", "called"),
    [
        ((), ["sun", "shared spatial correctives lights", "modulation"]),
        (("--stages", "lights"), ["shared lights"]),
        (("--stages", "field"), ["modulation"]),
        (("--stages", "field", "--hold-out-light", "l4"), ["sun", "modulation"]),
        (("--method", "sun"), ["sun"]),
        (("--method", "inverse_rendering"), ["shared"]),
        (
            (*("--method", "inverse_rendering"), *("--options", '{"fit": {"variant": "spatial"}}')),
            ["sun", "shared spatial"],
        ),
        (("--field", "additive"), ["additive"]),
        (("--field", "none"), ["none"]),
    ],
)
def test_the_stages_that_are_run(made, capsys, monkeypatch, words, called):
    """Old options too; an existing sun fit is used if it held out the same."""
    found = []
    monkeypatch.setattr(appearance, "fit", lambda **_: found.append("sun"))
    monkeypatch.setattr(
        appearance, "fit_maps", lambda stages, **_: found.append(" ".join(stages)) or {}
    )
    monkeypatch.setattr(
        appearance, "fit_field_validated", lambda request, **_: found.append(request.field) or {}
    )
    for name in ("relight", "assess"):
        monkeypatch.setitem(steps.STEPS, name, lambda _: {})
    assert run(capsys, "fit", made.capture, made.model, *words)[0] == 0
    assert found == called


def test_a_stage_that_there_is_not_is_named_with_those_there_are(made, capsys):
    with pytest.raises(SystemExit):
        main(["fit", str(made.capture), str(made.model), "--stages", "sun,shard"])
    assert "'shard' is no stage: name some of sun,shared,spatial" in capsys.readouterr().err


@pytest.mark.usefixtures("fitted")
def test_an_estimate_lists_the_stages_that_would_run_and_writes_nothing(made, capsys):
    before = {name: path.stat().st_mtime for name, path in made.model.artifacts().items()}
    words = ("fit", made.capture, made.model, "--stages", "spatial", "--estimate")
    code, data = run(capsys, *words)
    assert code == 0
    assert [x["name"] for x in data["stages"]] == ["shared", "spatial"]
    assert data["seconds"] == pytest.approx(sum(x["seconds"] for x in data["stages"]))
    after = {name: path.stat().st_mtime for name, path in made.model.artifacts().items()}
    assert after == before


def dyed_points(before: FittedModel, folder: Path) -> np.ndarray:
    """Which points `(S, n)` of the same strands have another colour in the model `folder`."""
    looks = [
        at_points(maps, before.strands, before.root_uv)[0]
        for maps in (before.maps, FittedModel.load(Model(folder)).maps)
    ]
    return (np.abs(looks[1] - looks[0]) > 1e-4).any(axis=1).reshape(len(before.strands), -1)


@pytest.mark.usefixtures("fitted")
def test_edits_are_saved_as_a_model_of_their_own(made, capsys, tmp_path):
    before = FittedModel.load(made.model)
    write_strands(tmp_path / "other.npz", tuft(50, seed=3))
    code, _ = run(
        *(capsys, "edit", made.model, "--out", tmp_path / "all", "--strands"),
        *(tmp_path / "other.npz", "--cut", 0.03, "--pigment", "0.5,0.1", "--roughen", 1.5),
    )
    assert code == 0
    after = FittedModel.load(Model(tmp_path / "all"))
    assert len(after.strands) == len(after.root_uv) == 50
    assert after.strands.lengths().max() == pytest.approx(0.03, rel=1e-3)
    assert after.maps.beta_m == pytest.approx(1.5 * before.maps.beta_m)
    pigments = 0.5 * np.array([0.419, 0.697, 1.37]) + 0.1 * np.array([0.187, 0.4, 1.05])
    np.testing.assert_allclose(after.maps.sigma_a.reshape(-1, 3)[0], pigments, rtol=1e-5)
    u, v = before.root_uv[0]
    code, _ = run(
        *(capsys, "edit", made.model, "--out", tmp_path / "wisp", "--recolour", "0.9,0.1,0.1"),
        *("--wisp", f"{u},{v},0.1", "--along", "0.5,1"),
    )
    assert code == 0
    dyed = dyed_points(before, tmp_path / "wisp")
    far = np.hypot(*(before.root_uv - (u, v)).T)
    assert dyed[far < 0.1, -1].all()
    assert not dyed[far > 0.1 + np.sqrt(2) / 32].any()  # a cell of the brush away
    assert not dyed[:, np.linspace(0, 1, dyed.shape[1]) < 0.5 - 1 / 7].any()
    code, _ = run(
        *(capsys, "edit", made.model, "--out", tmp_path / "band", "--recolour", "0.9,0.1,0.1"),
        *("--along", "0.3,0.4"),
    )
    assert code == 0
    along = np.linspace(0, 1, dyed.shape[1])
    dyed = dyed_points(before, tmp_path / "band")
    assert dyed[:, np.abs(along - 0.35) < 0.05].all()
    assert not dyed[:, np.abs(along - 0.35) > 0.05 + 1 / 7].any()
    code, _ = run(capsys, "render", tmp_path / "wisp", "--spp", 1, "--out", tmp_path / "x.png")
    assert code == 0
    lights = [Model(m).json("lights.json") for m in (made.model.path, tmp_path / "band")]
    assert lights[0] == lights[1]
    words = ["edit", str(made.model), "--out", str(tmp_path / "bare"), "--roughen", "1.1"]
    assert main(words) == 0
    assert "has no head" in capsys.readouterr().err


@pytest.mark.usefixtures("fitted")
def test_an_edited_model_keeps_its_scalp_map_and_shows_its_material(made, capsys, tmp_path):
    before = Model(shutil.copytree(made.model.path, tmp_path / "before"))
    strands, roots = before.strands(), FittedModel.load(before).root_uv
    known = {"uv": np.zeros((3, 2)), "vertices": np.eye(3), "faces": np.array([[0, 1, 2]])}
    before.write_arrays("scalp_map.npz", {**known, "roots": roots})
    write_strands(tmp_path / "few.npz", strands.subset([7, 3]))
    words = ("edit", before, "--out", tmp_path / "after", "--strands", tmp_path / "few.npz")
    assert run(capsys, *words, "--roughen", 1.5)[0] == 0
    after = Model(tmp_path / "after")
    held = after.arrays("scalp_map.npz")
    np.testing.assert_allclose(held["roots"], roots[[7, 3]], rtol=1e-6)
    np.testing.assert_array_equal(held["vertices"], np.eye(3))
    beta_m = 1.5 * FittedModel.load(before).maps.beta_m
    page = after.file("index.html").read_text(encoding="utf-8")
    assert f"β_M {beta_m:.2f}" in page
    assert "(inverse rendering)." not in page
    assert after.json("appearance.json")["hair"]["beta_m"] == pytest.approx(beta_m)


@pytest.mark.usefixtures("fitted")
@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "--recolour"),
        (("--recolour", "1,1,1", "--along", "0.8,0.2"), "0 <= a < b <= 1"),
        (("--recolour", "1,1,1", "--along", "2,3"), "0 <= a < b <= 1"),
        (("--wisp", "0,0,1"), "--recolour"),
        (("--cut", "-1"), "above 0"),
        (("--cut", "inf"), "a finite length"),
        (("--roughen", "100"), "beta_m"),
        (("--recolour", "2,0,0"), "at most 1"),
        (("--pigment=-1,0",), "0 or more"),
        (("--recolour", "1,1,1", "--wisp", "9,9,0.1"), "no strand"),
        (("--strands", "nowhere.npz"), "nowhere.npz"),
    ],
)
def test_edits_that_cannot_be_made_are_one_sentence(made, capsys, tmp_path, words, said):
    code, found = run(capsys, "edit", made.model, "--out", tmp_path / "out", *words)
    assert code == 3
    assert said in found["error"]["detail"]
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("fitted")
def test_exports_are_what_other_readers_open(made, capsys, tmp_path):
    files = {"usd": "h.usdc", "hair": "h.hair", "abc": "h.abc", "unreal": "u.abc", "gltf": "h.glb"}
    files["ply"] = "h.ply"
    for kind, name in files.items():
        code, found = run(capsys, "export", made.model, "--to", kind, "--out", tmp_path / name)
        assert (code, found["files"][0]) == (0, str(tmp_path / name))
    assert (tmp_path / "h.abc").read_bytes().startswith(b"Ogawa")
    for name in ("h.usdc", "h.hair", "h.abc", "h.ply"):
        assert len(read_strands(tmp_path / name)) == 200
    code, found = run(capsys, "export", made.model, "--to", "maps", "--out", tmp_path / "maps")
    assert code == 0
    assert (tmp_path / "maps" / "sigma_a_00.exr").is_file()
    words = ("--capture", made.capture, "--camera", "cam_1", "--out", tmp_path / "mi")
    assert run(capsys, "export", made.model, "--to", "mitsuba", *words)[0] == 0
    assert (tmp_path / "mi" / "scene.xml").is_file()
    code, found = run(capsys, "export", made.model, "--to", "hair", "--out", tmp_path / "x.usd")
    assert code == 3
    assert ".hair" in found["error"]["detail"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--seed", "-1"), "--seed -1: expected 0 or more"),
        (("--spp", "0"), "--spp 0: expected 1 or more"),
        (("--size", "100000"), "--size 100000: expected 16 to 16384"),
        (("--guide", "none"), "--field interpolation"),
        (("--frames", "9"), "--frames needs --turntable"),
        (("--turntable", "--frames", "1"), "--frames 1: expected 2 to 1000"),
        (("--capture", "{capture}", "--camera", "c0", "--size", "64"), "--size and --camera"),
    ],
)
def test_render_options_without_effect_are_refused(made, capsys, words, said):
    arguments = [str(made.model), *(w.format(capture=made.capture) for w in words)]
    code, found = run(capsys, "render", *arguments)
    assert code == 3
    assert said in found["error"]["detail"]


@pytest.mark.usefixtures("fitted")
def test_exports_warn_about_omitted_data(made, capsys, tmp_path, monkeypatch):
    model = Model(shutil.copytree(made.model.path, tmp_path / "model"))
    capture = shutil.copytree(made.capture, tmp_path / "moved")
    plan = json.loads((capture / "plan.json").read_text())
    plan["import"] = {"notes": [], "frame": {"unit": 1e-3, "origin": [0.5, -2.0, 1.25]}}
    (capture / "plan.json").write_text(json.dumps(plan))
    hair = ["export", str(model), "--to", "hair", "--out", str(tmp_path / "moved.hair")]
    assert main([*hair, "--capture", str(capture)]) == 0
    said = capsys.readouterr().err
    assert "z up, unit 0.001 m, the stage's origin at (0.5, -2, 1.25) m" in said
    words = ["export", str(model), "--to", "maps", "--out", str(tmp_path / "maps")]
    assert main([*words, "--capture", str(capture)]) == 0
    said = capsys.readouterr().err
    assert "field" not in said
    model.file("field.npz").write_bytes(b"")
    monkeypatch.setattr(Field, "load", lambda _: None)
    assert main([*words, "--capture", str(made.capture)]) == 0
    said = capsys.readouterr().err
    assert "was moved" not in said
    assert "reflectance field" in said


@pytest.mark.usefixtures("fitted")
def test_a_mitsuba_scene_warns_about_the_omitted_lens(made, capsys, tmp_path):
    """Its rows are 9.5 pixels from the middle at most, and 9.5 / 1.2 where a pixel is as high as
    wide; the lens puts at the corner what is two pixels outside of it without one."""
    capture = shutil.copytree(made.capture, tmp_path / "capture")
    rig = json.loads((capture / "rig.json").read_text())
    straight, (low, bent) = rig["cameras"], copy.deepcopy(rig["cameras"])
    low["K"][1][1] *= 1.2
    focal = bent["K"][0][0]
    corner = np.hypot(9.5, 9.5) / focal
    beyond = corner + 2 / focal
    bent["distortion"] = [(corner / beyond - 1) / beyond**2]  # r (1 + k1 r²)
    words = ["export", str(made.model), "--to", "mitsuba", "--capture", str(capture)]
    for cameras, said in (([low, bent], ("1.6 pixels", "2.0 pixels")), (straight, ("", ""))):
        (capture / "rig.json").write_text(json.dumps(rig | {"cameras": cameras}))
        for name, off in zip(("cam_0", "cam_1"), said, strict=True):
            assert main([*words, "--camera", name, "--out", str(tmp_path / name)]) == 0
            output = capsys.readouterr().err
            assert (f"{name} has lens distortion" in output, off in output) == (off != "", True)


def test_a_head_without_hair_is_a_scene_for_mitsuba_where_a_camera_is_given(made, capsys, tmp_path):
    """A view that shows all strands there is not: its error asks for what is given here."""
    bald = Model(tmp_path / "bald").create()
    bald.write_strands(Strands.from_list([]))
    words = ("export", bald, "--to", "mitsuba", "--out", tmp_path / "scene")
    code, found = run(capsys, *words)
    assert (code, "give a camera of the capture's rig" in found["error"]["detail"]) == (3, True)
    code, found = run(capsys, *words, "--capture", made.capture, "--camera", "cam_1")
    written = [str(tmp_path / "scene" / f) for f in ("scene.xml", "environment.exr")]
    assert (code, found.get("files")) == (0, written)


def test_a_file_is_printed_by_the_name_that_it_has(made, capsys, tmp_path):
    out = tmp_path / "a:x:b" / "[i] h:100:.hair"
    assert main(["export", str(made.model), "--to", "hair", "--out", str(out)]) == 0
    printed = capsys.readouterr().out.rstrip("\n")
    assert (printed, Path(printed).is_file()) == (str(out), True)


@pytest.mark.usefixtures("fitted")
def test_exports_make_their_folders_and_take_no_place_of_a_models_files(made, capsys, tmp_path):
    deep = tmp_path / "new" / "folder" / "h.hair"
    assert run(capsys, "export", made.model, "--to", "hair", "--out", deep)[0] == 0
    assert len(read_strands(deep)) == 200
    before = {p: p.read_bytes() for p in made.folder.rglob("*") if p.is_file()}
    for kind, out in (
        ("mitsuba", made.capture),  # its head would be in centimetres
        ("mitsuba", made.model.path),
        ("hair", made.model.file("strands.hair")),
        ("usd", made.model.file("strands.usdc")),
    ):
        words = ("--to", kind, "--strands", 5, "--out", out)
        code, found = run(capsys, "export", made.model, *words)
        assert (code, "choose another folder" in found["error"]["detail"]) == (3, True)
    assert {p: p.read_bytes() for p in made.folder.rglob("*") if p.is_file()} == before
    code, found = run(capsys, "edit", made.model, "--cut", 1, "--out", deep)
    assert (code, "not an empty folder" in found["error"]["detail"]) == (3, True)


def test_a_model_is_not_made_among_others_files(made, capsys, tmp_path, monkeypatch):
    """It would remove a head.obj that is not its own, and plots with all that is in it."""
    capture = shutil.copytree(made.capture, tmp_path / "capture")
    work, model = tmp_path / "my work", shutil.copytree(made.model.path, tmp_path / "model")
    (work / "plots").mkdir(parents=True)
    for file in (capture / "head.obj", work / "head.obj", work / "plots" / "mine.png"):
        file.write_text("mine")
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    for out in (capture, work, work / "head.obj"):
        code, found = run(capsys, "reconstruct", made.capture, "--out", out)
        assert (code, f"--out {out} " in found["error"]["detail"]) == (3, True)
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before
    monkeypatch.setattr(steps, "reconstruct", lambda _: {})
    assert run(capsys, "reconstruct", made.capture, "--out", model)[0] == 0  # once more


def test_hair_inside_a_head_is_counted_pushed_out_or_cut(made, capsys, tmp_path):
    """The tuft's strands rise from z = -0.03 to 0.03 through a box that is 2 cm high."""
    box = Mesh(*box_of((-0.05, -0.05, -0.01), (0.05, 0.05, 0.01)))
    write_obj(tmp_path / "box.obj", box)
    words = ("export", made.model, "--to", "hair", "--head", tmp_path / "box.obj")
    code, found = run(capsys, *words, "--out", tmp_path / "n.hair", "--collide", "count")
    assert code == 0
    assert found["inside_head"]["strands"] == 200
    assert found["inside_head"]["metres"] == pytest.approx(200 * 0.02, rel=0.02)
    assert found["inside_head"]["deepest_mm"] == pytest.approx(10, abs=0.1)
    code, found = run(capsys, *words, "--out", tmp_path / "c.hair", "--collide", "cut")
    assert (code, found["inside_head_after"]["strands"]) == (0, 0)
    cut = read_strands(tmp_path / "c.hair")
    assert len(cut) == 400
    assert cut.lengths().sum() == pytest.approx(200 * 0.04, rel=0.02)
    usd = ("export", made.model, "--to", "usd", "--head", tmp_path / "box.obj")
    code, found = run(capsys, *usd, "--out", tmp_path / "c.usdc", "--collide", "cut")
    assert code == 0
    assert len(read_strands(tmp_path / "c.usdc")) == 400
    for count in (50, 300):  # strands that are added are cut, too
        many = (*words, "--out", tmp_path / "c.hair", "--collide", "cut", "--strands", count)
        code, found = run(capsys, *many)
        assert (code, found["inside_head"]["strands"]) == (0, count)
        assert len(read_strands(tmp_path / "c.hair")) == 2 * count
    code, found = run(capsys, *words, "--out", tmp_path / "n.hair")
    assert code != 0
    assert "--head needs --collide" in found["error"]["detail"]
    none = ("export", made.model, "--to", "hair", "--out", tmp_path / "n.hair")
    code, found = run(capsys, *none, "--collide", "push")
    assert code != 0
    assert "needs a head" in found["error"]["detail"]


def box_of(low, high):
    """Vertices and outward faces of a box."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return np.where(corners, high, low), np.array(faces)
