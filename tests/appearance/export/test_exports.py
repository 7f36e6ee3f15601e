"""Exports, read back by others' readers: units, axes, counts, widths, colours."""

from __future__ import annotations

import json
import re
import runpy
import struct
import subprocess
import sys
from dataclasses import replace
from unittest.mock import MagicMock

import cv2
import mitsuba as mi
import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade, UsdValidation
from scipy.spatial import cKDTree

from appearance import Exposure, FittedModel, HairAppearance, HeldOut, Sampling, render_environment
from appearance.bsdf.maps import HairMaps
from appearance.export.blender import export_blender
from appearance.export.cards import export_gltf, make_cards
from appearance.export.groom import Groom, clumps, shapes
from appearance.export.mitsuba import View, export_mitsuba
from appearance.export.options import ExportOptions
from appearance.export.unreal import export_unreal
from appearance.export.usd import export_usd
from appearance.render.environment_maps import studio
from appearance.sun_fit.fitted_appearance import FittedAppearance
from reconstruction import BadOptions, Camera, Strands, parse_options, read_exr, read_strands
from reconstruction.files import durable

HAIR = HairAppearance((0.06, 0.12, 0.3), 0.25, 0.35)
SKIN = (0.3, 0.2, 0.1)
STOCK = """
import sys, reconstruction.libllvm, drjit as dr, mitsuba as mi, numpy as np
mi.set_variant("llvm_ad_rgb")
dr.set_thread_count(2)
np.save(sys.argv[2], np.array(mi.render(mi.load_file(sys.argv[1]), seed=0))[..., :3])
"""


@pytest.fixture(scope="module")
def fitted(small):
    """A tuft on a ball, of one colour."""
    appearance = FittedAppearance(HAIR, SKIN, SKIN, Exposure(1.0), 0.1, 0.1, 0.1, HeldOut())
    strands = small.tuft(60)
    ball = small.ball(rows=8).transformed(np.eye(3), (0, 0, -0.11))
    return FittedModel(strands, ball, appearance, HairMaps.of(HAIR))


@pytest.fixture(scope="module")
def mapped(fitted):
    """Darker at the tips and, where u is small, red; no correctives."""
    base = HairMaps.of(HAIR, (3, 4, 4))
    sigma_a = base.sigma_a * np.array([0.5, 1.0, 2.0])[:, None, None, None]
    sigma_a[:, :2] = (0.05, 0.9, 1.1)
    return fitted.with_maps(replace(base, sigma_a=sigma_a))


def test_a_strand_straight_off_the_head_is_a_card_with_a_side(fitted, tmp_path):
    """Of all ways across such a card none is level with the head."""
    line = np.array([[0, 0, 0.1], [0, 0, 0.2]])
    bristle = replace(fitted, strands=Strands.from_list([line], radius=5e-5), head=None)
    cards = make_cards(Groom.of(bristle, ExportOptions()), 1, 4, 0)
    assert (cards.half >= 5e-5).all()
    for unit in (cards.across, cards.normal):
        np.testing.assert_allclose(np.linalg.norm(unit, axis=2), 1)
        np.testing.assert_allclose(unit[..., 2], 0, atol=1e-12)  # at right angles to the strand
    np.testing.assert_array_equal(cards.across, np.broadcast_to(cards.across[:, :1], (1, 5, 3)))


def test_clumps_are_the_wisps_that_are_there():
    rng = np.random.default_rng(0)
    line = np.array([[0, 0, 0], [0, 0, 0.05], [0, 0.01, 0.1]])
    wisps = rng.integers(0, 4, 80)
    lines = [line + np.array([0.1 * w, 0, 0]) + rng.normal(scale=1e-3, size=3) for w in wisps]
    guides, clump = clumps(Strands.from_list(lines), 4, 0)
    assert len(guides) <= 4
    np.testing.assert_array_equal(clump[guides], np.arange(len(guides)))
    # whatever k-means made of them, a strand goes with a guide of its own wisp or one as near
    shape = shapes(Strands.from_list(lines)).reshape(80, -1)
    distance, _ = cKDTree(shape[guides]).query(shape)
    own = np.linalg.norm(shape - shape[guides][clump], axis=1)
    np.testing.assert_allclose(own, distance)


def test_strands_that_are_alike_are_one_clump():
    line = np.array([[0, 0, 0], [0, 0, 0.05]])
    guides, clump = clumps(Strands.from_list([line] * 5 + [line + 0.1]), 4, 0)
    assert len(guides) == len(set(clump.tolist())) == 2
    assert clump.tolist() == [clump[0]] * 5 + [1 - clump[0]]


def test_shapes_are_points_at_equal_arc_lengths():
    bent = Strands.from_list([np.array([[0, 0, 0], [0.01, 0, 0], [0.01, 0.03, 0]])])
    expected = [[0, 0, 0], [0.01, 0, 0], [0.01, 0.01, 0], [0.01, 0.02, 0], [0.01, 0.03, 0]]
    np.testing.assert_allclose(shapes(bent, 5)[0], expected, atol=1e-8)


def test_confidence_says_how_near_measurements_are(fitted):
    points = fitted.strands.points[:8] + np.array([0, 0, 0.002])
    groom = Groom.of(fitted, ExportOptions(), points)
    expected = np.exp(-0.5 * (cKDTree(points).query(fitted.strands.points)[0] / 0.002) ** 2)
    np.testing.assert_allclose(groom.confidence, expected, atol=1e-5)
    assert Groom.of(fitted, ExportOptions(), points[:0]).confidence is None


@pytest.mark.parametrize("up", ["Z", "Y"])
def test_usd_has_hair_head_and_guides_in_one_frame(fitted, tmp_path, up):
    groom = Groom.of(fitted, ExportOptions(strands=40, guides=5), fitted.strands.points[::5])
    assert export_usd(groom, tmp_path / "m.usdc", up=up) == [tmp_path / "m.usdc"]
    stage = Usd.Stage.Open(str(tmp_path / "m.usdc"))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == (up, 1.0)
    assert stage.GetDefaultPrim().GetPath() == "/model"
    back = read_strands(tmp_path / "m.usdc")  # turned to z up again, the guides left out
    np.testing.assert_allclose(back.points, groom.strands.points, atol=1e-7)
    assert back.radius == pytest.approx(4e-4 * 60 / 40, rel=0.1)
    turn = np.eye(3) if up == "Z" else np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    head = UsdGeom.Mesh(stage.GetPrimAtPath("/model/head"))
    np.testing.assert_allclose(
        np.array(head.GetPointsAttr().Get()), fitted.head.vertices @ turn.T, atol=1e-7
    )
    api = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/model/hair"))
    held = {
        p.GetPrimvarName(): (p.GetInterpolation(), len(p.Get()) if p.GetTypeName().isArray else 1)
        for p in api.GetPrimvarsWithValues()
    }
    assert held["st"] == held["strand_id"] == held["clump"] == ("uniform", 40)
    assert held["confidence"] == ("vertex", 320)
    assert held["sigma_a"] == ("constant", 1)
    np.testing.assert_array_equal(api.GetPrimvar("strand_id").Get(), groom.ids)
    guides = UsdGeom.BasisCurves(stage.GetPrimAtPath("/model/guides"))
    assert len(guides.GetCurveVertexCountsAttr().Get()) == len(groom.guides)
    errors = UsdValidation.ValidationContext(
        UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    ).Validate(stage)
    # usd-core comes without MaterialX's definitions, and takes its nodes for unknown
    assert [e.GetMessage() for e in errors if "'ND_" not in e.GetMessage()] == []


def test_usd_hair_is_chiangs_with_our_parameters(fitted, tmp_path):
    export_usd(Groom.of(fitted, ExportOptions()), tmp_path / "m.usda")
    stage = Usd.Stage.Open(str(tmp_path / "m.usda"))
    material = UsdShade.Material(stage.GetPrimAtPath("/model/materials/hair"))
    bsdf = UsdShade.Shader(stage.GetPrimAtPath("/model/materials/hair/bsdf"))
    roughness = UsdShade.Shader(stage.GetPrimAtPath("/model/materials/hair/roughness"))
    assert bsdf.GetIdAttr().Get() == "ND_chiang_hair_bsdf"
    np.testing.assert_allclose(bsdf.GetInput("absorption_coefficient").Get(), HAIR.sigma_a)
    assert bsdf.GetInput("ior").Get() == pytest.approx(1.55)
    # MaterialX: [0, 1] is [-pi/2, pi/2]
    angle = bsdf.GetInput("cuticle_angle").Get() * 180 - 90
    assert angle == pytest.approx(2.0, abs=1e-4)
    given = [roughness.GetInput(k).Get() for k in ("longitudinal", "azimuthal")]
    assert given == pytest.approx([0.25, 0.35])
    surface, _, _ = material.ComputeSurfaceSource("mtlx")
    assert surface.GetIdAttr().Get() == "ND_surface"
    bound = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath("/model/hair")).ComputeBoundMaterial()
    assert bound[0].GetPath() == material.GetPath()


def test_usd_textures_hold_the_maps_where_st_looks_them_up(mapped, tmp_path):
    groom = Groom.of(mapped, ExportOptions())
    files = export_usd(groom, tmp_path / "m.usdc")
    assert [f.name for f in files[1:]] == ["sigma_a_00.exr", "sigma_a_01.exr", "sigma_a_02.exr"]
    stage = Usd.Stage.Open(str(tmp_path / "m.usdc"))
    for i in range(3):
        image = UsdShade.Shader(stage.GetPrimAtPath(f"/model/materials/hair/layer_{i:02d}"))
        asset = image.GetInput("file").Get()
        assert asset.resolvedPath == str(files[1 + i])
        # MaterialX repeats a picture where nothing is said: 1 would be in the first cell again
        assert [image.GetInput(f"{a}addressmode").Get() for a in "uv"] == ["clamp", "clamp"]
    api = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/model/hair"))
    sigma_a = np.array(api.GetPrimvar("sigma_a").Get()).reshape(60, 8, 3)
    st = np.array(api.GetPrimvar("st").Get())
    for layer, at in ((0, 0), (2, 7)):  # the root's, and the tip's
        texture, _ = read_exr(files[1 + layer])
        row = np.minimum(((1 - st[:, 1]) * 4).astype(int), 3)  # t is up, a picture's rows go down
        column = np.minimum((st[:, 0] * 4).astype(int), 3)
        np.testing.assert_allclose(sigma_a[:, at], texture[row, column], rtol=1e-5)


@pytest.mark.parametrize("limits", [{}, {"MOST_STRANDS": 25}, {"MOST_GROUP_POINTS": 30 * 255}])
def test_unreal_gets_what_its_groups_hold(fitted, tmp_path, monkeypatch, limits):
    """255 points a strand with both ends, every strand in one of the groups."""
    pytest.importorskip("imath", reason="the extra 'alembic' is not installed")
    from alembic3d import Abc, AbcGeom

    for name, value in limits.items():
        monkeypatch.setattr(f"appearance.export.unreal.{name}", value)
    lines = [np.linspace(s[0], s[-1], 400) for s in (fitted.strands[i] for i in range(60))]
    groom = Groom.of(replace(fitted, strands=Strands.from_list(lines)), ExportOptions(guides=5))
    notes = export_unreal(groom, tmp_path / "g.abc")
    assert notes[0].startswith("60 strands have over 255 points")
    assert len(notes) == 1 + bool(limits)
    top, found, ids = Abc.IArchive(str(tmp_path / "g.abc")).getTop(), [], []
    names = [top.getChild(i).getName() for i in range(top.getNumChildren())]
    hair = sorted(n for n in names if n.startswith("hair"))
    for group, name in enumerate(hair):
        schema = AbcGeom.ICurves(top, name).getSchema()
        counts = np.asarray(memoryview(schema.getValue().getCurvesNumVertices()))
        assert set(counts) == {255}
        found.append(np.array(memoryview(schema.getValue().getPositions())).reshape(-1, 255, 3))
        held = schema.getArbGeomParams()
        for param, into in (("groom_group_id", []), ("groom_id", ids)):
            into += list(AbcGeom.IInt32GeomParam(held, param).getExpandedValue().getVals())
            assert param != "groom_group_id" or into == [group]
    assert [len(f) for f in found] == {0: [60], 25: [25, 25, 10], 7650: [30, 30]}[
        next(iter(limits.values()), 0)
    ]
    assert ids == list(range(60))
    every = np.concatenate(found) / 100
    for k, end in ((0, 0), (-1, -1)):
        expected = [line[end] for line in lines]
        np.testing.assert_allclose(every[:, k], expected, atol=1e-6)


def test_unreal_alembic_is_in_centimetres_with_its_attributes(fitted, tmp_path, monkeypatch):
    pytest.importorskip("imath", reason="the extra 'alembic' is not installed")
    from alembic3d import Abc, AbcGeom

    groom, flushed = Groom.of(fitted, ExportOptions(guides=5)), []
    monkeypatch.setattr(durable, "flush", lambda part: flushed.append(part.read_bytes()))
    export_unreal(groom, tmp_path / "g.abc")
    assert flushed == [(tmp_path / "g.abc").read_bytes()], "whole before it gets its name"
    top = Abc.IArchive(str(tmp_path / "g.abc")).getTop()
    schema = AbcGeom.ICurves(top, "hair").getSchema()
    points = np.asarray(memoryview(schema.getValue().getPositions()))
    np.testing.assert_allclose(points, 100 * fitted.strands.points, rtol=1e-6)
    assert schema.getValue().getBasis() == AbcGeom.BasisType.kNoBasis
    held = schema.getArbGeomParams()

    def read(kind: str, name: str):
        value = getattr(AbcGeom, f"I{kind}GeomParam")(held, name).getExpandedValue()
        return value.getScope(), [tuple(v) if kind[0] == "V" else v for v in value.getVals()]

    scopes = AbcGeom.GeometryScope
    uv = groom.root_uv * (1, -1) + (0, 1)
    scope, values = read("V2f", "groom_root_uv")
    assert scope == scopes.kUniformScope
    np.testing.assert_allclose(values, uv, atol=1e-6)
    assert read("Int32", "groom_id") == (scopes.kUniformScope, list(range(60)))
    assert read("Int32", "groom_group_id") == (scopes.kConstantScope, [0])
    scope, width = read("Float", "groom_width")
    assert (scope, len(width)) == (scopes.kVertexScope, 480)
    np.testing.assert_allclose(width, 0.08)  # cm: twice 0.4 mm
    held = AbcGeom.ICurves(top, "guides").getSchema().getArbGeomParams()
    assert read("Int16", "groom_guide") == (scopes.kConstantScope, [1])


@pytest.mark.parametrize("which", ["fitted", "mapped"])
def test_stock_mitsuba_renders_our_picture(which, request, tmp_path):
    """Light from one side and a head: axes, colours and exposure all count. Both estimates are
    noisy: their difference is held against that of two of ours."""
    model = request.getfixturevalue(which)
    camera = Camera.look_at("c", 16, 16, (0.1, -0.5, 0.1), (0, 0, -0.02), 14)
    light = studio()
    groom = Groom.of(model, ExportOptions())
    written = export_mitsuba(groom, tmp_path, View(camera, light, spp=256))
    assert sorted(written) == sorted(tmp_path.iterdir())
    path = written[0]
    # elsewhere: with one thread, as tests have, Mitsuba waits for itself while it reads an EXR
    subprocess.run([sys.executable, "-c", STOCK, str(path), str(tmp_path / "s.npy")], check=True)
    stock = np.load(tmp_path / "s.npy")
    ours = [
        np.array(render_environment(model.scene(), camera, light, Sampling(256, 16, seed)))
        for seed in (1, 2)
    ]
    covered = ours[0].sum(axis=-1) > 0
    mean = 0.5 * (ours[0] + ours[1])
    np.testing.assert_allclose(stock[covered].mean(axis=0), mean[covered].mean(axis=0), rtol=0.03)
    noise = np.sqrt(((ours[0] - ours[1])[covered] ** 2).mean())
    assert (
        np.sqrt(((stock - mean)[covered] ** 2).mean()) < 1.5 * noise + 0.02 * mean[covered].mean()
    )


def test_mitsubas_camera_sees_a_point_where_ours_does(fitted, tmp_path):
    """Of a calibrated camera, whose principal point is not in the middle of its pictures."""
    camera = Camera.look_at("c", 64, 48, (0.1, -0.5, 0.1), (0, 0, -0.02), 14)
    camera = replace(camera, K=camera.K + np.array([[0, 0, 9.0], [0, 0, -5.0], [0, 0, 0]]))
    groom = Groom.of(fitted, ExportOptions())
    path, *_ = export_mitsuba(groom, tmp_path, View(camera, np.ones((4, 8, 3), np.float32)))
    sensor = re.search(r"<sensor.*</sensor>", path.read_text(), re.DOTALL)
    theirs = mi.load_string(f'<scene version="3.0.0">{sensor[0]}</scene>').sensors()[0]
    for pixel in ([0, 0], [63, 0], [20, 40]):
        at = mi.Point2f((pixel[0] + 0.5) / 64, (pixel[1] + 0.5) / 48)
        ray, _ = theirs.sample_ray(0, 0, at, mi.Point2f(0.5))
        point = np.array(ray(40.0)).ravel() / 100
        np.testing.assert_allclose(camera.project(point[None])[0][0], pixel, atol=1e-3)


def read_glb(path):
    """JSON and binary chunk, by the specification's chapter 4.4."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    text = json.loads(data[20 : 20 + size])
    more, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert (kind, 28 + size + more) == (b"BIN\0", length)
    return text, data[28 + size :]


def test_gltf_cards_lie_in_the_hair_with_the_face_along_z(fitted, tmp_path):
    export_gltf(Groom.of(fitted, ExportOptions()), tmp_path / "h.glb", 16)
    gltf, data = read_glb(tmp_path / "h.glb")

    def accessor(index):
        a = gltf["accessors"][index]
        start = gltf["bufferViews"][a["bufferView"]]["byteOffset"]
        kind, width = {5126: "<f4", 5125: "<u4"}[a["componentType"]], {"SCALAR": 1, "VEC2": 2}
        columns = width.get(a["type"], 3)
        return np.frombuffer(data, kind, a["count"] * columns, start).reshape(-1, columns)

    names = [n["name"] for n in gltf["nodes"]]
    assert names == ["hair_lod0", "hair_lod1", "hair_lod2", "head"]
    assert gltf["nodes"][0]["extensions"]["MSFT_lod"]["ids"] == [1, 2]
    assert gltf["scenes"][0]["nodes"] == [0, 3]
    turned = fitted.strands.points[:, [0, 2, 1]] * (1, 1, -1)  # y up, the face from -y to +z
    cards = []
    for level in range(3):
        (part,) = gltf["meshes"][level]["primitives"]
        at = {k: accessor(v) for k, v in part["attributes"].items()}
        faces = accessor(part["indices"]).reshape(-1, 3)
        segments = (12, 8, 5)[level]
        cards.append(len(faces) // (2 * segments))
        assert len(at["POSITION"]) == 2 * (segments + 1) * cards[-1]
        assert faces.max() == len(at["POSITION"]) - 1
        np.testing.assert_allclose(np.linalg.norm(at["NORMAL"], axis=1), 1, rtol=1e-4)
        assert ((at["TEXCOORD_0"] >= 0) & (at["TEXCOORD_0"] <= 1)).all()
        distance, _ = cKDTree(turned).query(at["POSITION"])
        assert np.median(distance) < 0.01
    assert cards[0] <= 16
    assert cards[0] > cards[1] >= cards[2] >= 1
    view = gltf["bufferViews"][gltf["images"][0]["bufferView"]]
    png = np.frombuffer(data, np.uint8, view["byteLength"], view["byteOffset"])
    picture = cv2.imdecode(png, cv2.IMREAD_UNCHANGED)
    inside = picture[picture[..., 3] > 128][:, 2::-1] / 255
    linear = np.where(inside <= 0.04045, inside / 12.92, ((inside + 0.055) / 1.055) ** 2.4)
    colour = fitted.maps.mean().sigma_a
    expected = Groom.of(fitted, ExportOptions()).colour(np.array(colour))
    np.testing.assert_allclose(np.median(linear, axis=0), expected, atol=0.01)


def test_blender_gets_arrays_and_a_script_that_python_reads(mapped, tmp_path):
    groom = Groom.of(mapped, ExportOptions(guides=5))
    script, arrays = export_blender(groom, tmp_path / "b")
    subprocess.run([sys.executable, "-m", "py_compile", str(script)], check=True)
    held = np.load(arrays)
    assert held["points"].shape == (480, 3)
    assert held["counts"].tolist() == [8] * 60
    np.testing.assert_allclose(held["radius"], 4e-4)
    assert held["sigma_a"].shape == (480, 3)
    np.testing.assert_allclose(held["head_vertices"], mapped.head.vertices, atol=1e-7)


def test_blender_finds_every_root_in_one_face_of_the_head(fitted, tmp_path):
    """Its ReverseUVSampler takes none where triangles of several faces hold a place on the map."""
    head, radius = fitted.head, np.ptp(fitted.head.vertices[:, 0]) / 2
    x, y, z = (head.vertices - head.vertices.mean(axis=0)).T / radius
    uv = np.where(z[:, None] > 0.2, 0.5 + 0.5 * np.stack([x, y], axis=-1), np.nan)
    middles = uv[head.faces].mean(axis=1)
    roots = middles[np.isfinite(middles).all(axis=1) & (head.face_areas() > 1e-9)]
    assert 20 < len(roots) < len(head.faces) / 2
    groom = replace(Groom.of(fitted, ExportOptions()), head_uv=uv)
    _, arrays = export_blender(groom, tmp_path / "b")
    corners = np.load(arrays)["head_uv"].reshape(len(head.faces), 3, 2).astype(float)
    for place in roots * (1, -1) + (0, 1):  # v upwards there
        edges, away = np.roll(corners, -1, axis=1) - corners, place - corners
        side = edges[..., 0] * away[..., 1] - edges[..., 1] * away[..., 0]
        assert ((side > 1e-9).all(axis=1) | (side < -1e-9).all(axis=1)).sum() == 1


def test_blender_script_without_strands_adds_no_curves(fitted, tmp_path, monkeypatch):
    """`add_curves([])` ends Blender 4.5 by a segmentation fault."""
    bpy = MagicMock()
    added = bpy.data.hair_curves.new.return_value.add_curves
    monkeypatch.setitem(sys.modules, "bpy", bpy)
    for strands, expected in ((Strands.from_list([]), []), (fitted.strands, [[[8] * 60]])):
        groom = Groom.of(replace(fitted, strands=strands), ExportOptions())
        script, arrays = export_blender(groom, tmp_path)
        with np.load(arrays) as held:
            runpy.run_path(str(script))["build"](dict(held))
        assert [list(call.args) for call in added.call_args_list] == expected


def test_options_that_cannot_be_are_refused():
    """5,000 cards, 64 a row of 256 pixels, are 20,224 pixels: graphics cards take 16,384."""
    several = {"strands": 0}, {"guides": -1}, {"cards": 0}, {"cards": 5000}, {"seed": -1}
    for wrong in (*several, {"strand": 3}):
        with pytest.raises(BadOptions, match=next(iter(wrong))):
            parse_options(ExportOptions, wrong)


def test_bald_heads_are_exported_or_refused_in_a_sentence(fitted, tmp_path):
    bald = Groom.of(replace(fitted, strands=Strands.from_list([])), ExportOptions(guides=3))
    export_usd(bald, tmp_path / "b.usdc")
    export_blender(bald, tmp_path / "b")
    with pytest.raises(ValueError, match=r"h\.glb: there are no strands"):
        export_gltf(bald, tmp_path / "h.glb", 3)
