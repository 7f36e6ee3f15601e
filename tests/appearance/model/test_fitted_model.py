"""What is done with fitted maps: edits, moved strands, exports that others open."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from appearance import (
    Exposure,
    FittedModel,
    HairAppearance,
    HeldOut,
    Sampling,
    render_environment,
    render_olat,
)
from appearance.bsdf.maps import HairMaps
from appearance.bsdf.parameters import StrandHit
from appearance.export.groom import at_points
from appearance.export.maps import export_maps
from appearance.inverse_rendering.fitted_lights import save_lights
from appearance.model.edit import cut, recoloured, restyled, wisp_of
from appearance.sun_fit.fitted_appearance import FittedAppearance
from reconstruction import Camera, Model, Rig, read_exr
from reconstruction.files.strands import read_poses

HAIR = HairAppearance((0.06, 0.12, 0.3), 0.25, 0.35)
CAMERA = Camera.look_at("c", 16, 16, (0, -0.5, 0.1), (0, 0, 0.0), 12)


@pytest.fixture(scope="module")
def model(strands, root_uv, tmp_path_factory):
    """A model folder whose hair is darker at the tips, and half of it red."""
    model = Model(tmp_path_factory.mktemp("model"))
    base = HairMaps.of(HAIR, (3, 4, 4))
    sigma_a = base.sigma_a * np.array([0.5, 1.0, 2.0])[:, None, None, None]
    half = np.zeros((4, 4))
    half[:2] = 1
    maps = recoloured(replace(base, sigma_a=sigma_a), half, (0.02, 1.0, 1.2))
    model.write_strands(strands)
    maps.save(model, root_uv)
    skin = (0.3, 0.2, 0.1)
    FittedAppearance(HAIR, skin, skin, Exposure(1.0), 0.1, 0.1, 0.1, HeldOut()).save(model)
    return model


@pytest.fixture(scope="module")
def fitted(model):
    return FittedModel.load(model)


def test_a_brush_colours_its_wisp_and_nothing_else(fitted):
    uv = fitted.root_uv
    left = np.flatnonzero(uv[:, 0] < 0.5)
    brush = wisp_of(left, uv, (4, 4))
    np.testing.assert_allclose(brush[:2][brush[:2] > 0], 1)
    assert (brush[2:] == 0).all()
    dyed = recoloured(fitted.maps, brush, (3.0, 0.1, 0.1), along=(0.5, 1.0))
    changed = (dyed.sigma_a != fitted.maps.sigma_a).any(axis=(2, 3))
    assert changed.tolist() == [[False] * 4, [True, True, False, False], [True, True, False, False]]
    np.testing.assert_allclose(
        dyed.sigma_a[2, 0, brush[0] == 1], [[3.0, 0.1, 0.1]] * int((brush[0] == 1).sum())
    )
    assert recoloured(HairMaps.of(HAIR), brush, (1, 1, 1)).shape == (1, 4, 4)
    finer = np.zeros((9, 7))
    finer[:2] = 1  # and no more, though the maps' cells are twice as wide
    looks = [
        at_points(m, fitted.strands, uv)[0]
        for m in (fitted.maps, recoloured(fitted.maps, finer, (3.0, 0.1, 0.1)))
    ]
    differ = np.abs(looks[1] - looks[0]).max(axis=1) > 0
    np.testing.assert_array_equal(differ, (uv[:, 0] < 0.25)[fitted.strands.strand_of_point])
    soft = wisp_of(left, uv, (4, 4), soft=1.0)
    assert 0 < soft[2].max() < 1
    with pytest.raises(ValueError, match="brush"):
        recoloured(fitted.maps, brush + 1, (1, 1, 1))
    with pytest.raises(ValueError, match="sigma_a"):
        recoloured(fitted.maps, brush, (-1, 1, 1))


def test_dyed_and_smoother_hair_is_so_in_every_light(fitted, small):
    darker = recoloured(fitted.maps, np.ones((1, 1)), (5.0, 5.0, 5.0))
    lights = small.lights()[:1]
    pictures = [
        render_olat(fitted.with_maps(m).scene(), CAMERA, lights, spp=16, max_depth=4)
        for m in (fitted.maps, darker)
    ]
    assert pictures[1].mean() < 0.7 * pictures[0].mean()
    smoother = mi.traverse(fitted.with_maps(replace(fitted.maps, beta_m=0.1)).scene().hair_bsdf)
    assert smoother["longitudinal_roughness"][0] == pytest.approx(0.1)
    sky = np.ones((4, 8, 3), np.float32)
    assert render_environment(fitted.scene(), CAMERA, sky, Sampling(4, 4)).max() > 0.1


def test_maps_stay_on_strands_that_move_and_other_strands_are_refused(fitted, small):
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    moved = fitted.strands.transformed(turn, (0, 0, 0))
    camera = Camera.look_at("m", 16, 16, turn @ (0, -0.5, 0.1), (0, 0, 0), 12)
    light = replace(small.lights()[0], position=turn @ small.lights()[0].position)
    still = render_olat(fitted.scene(), CAMERA, small.lights()[:1], spp=64, max_depth=3)
    turned = render_olat(fitted.scene(strands=moved), camera, [light], spp=64, max_depth=3)
    np.testing.assert_allclose(turned.mean((1, 2)), still.mean((1, 2)), rtol=0.05)
    with pytest.raises(ValueError, match="same numbers of points"):
        fitted.scene(strands=small.tuft(5))


def test_poses_are_as_thick_as_the_models_strands(fitted, tmp_path):
    """A file of poses holds points and offsets; a missing radius would be that of one hair."""
    points, offsets = fitted.strands.points, fitted.strands.offsets
    np.savez(tmp_path / "poses.npz", points=np.stack([points, points + 0.01]), offsets=offsets)
    fitted = replace(fitted, strands=replace(fitted.strands, radius=3e-4))
    scene = fitted.scene(read_poses(tmp_path / "poses.npz")[1])
    radius = np.array(mi.traverse(scene.hair_shape)["control_points"]).reshape(-1, 4)[:, 3]
    np.testing.assert_allclose(radius[:-4], 0.03, rtol=1e-6)  # centimetres; the last are a guard


def test_maps_are_exported_as_layers_that_read_back(fitted, tmp_path):
    files = export_maps(fitted.maps, tmp_path)
    assert [f.name for f in files[:3]] == ["sigma_a_00.exr", "sigma_a_01.exr", "sigma_a_02.exr"]
    image, _ = read_exr(tmp_path / "sigma_a_01.exr")
    np.testing.assert_allclose(image, fitted.maps.sigma_a[1].transpose(1, 0, 2), rtol=1e-6)
    assert "beta_m" in (tmp_path / "maps.json").read_text()


def test_values_at_points_are_those_that_the_bsdf_looks_up(fitted):
    scene = fitted.scene()
    table = mi.TensorXf(fitted.maps.sigma_a.astype(np.float32))
    strands = fitted.strands
    segments = len(strands.points) - len(strands)
    si = dr.zeros(mi.SurfaceInteraction3f, segments)
    si.prim_index = dr.arange(mi.UInt32, segments)
    si.p = mi.Point3f(100 * strands.points[strands.segment_starts].T)
    place = StrandHit(mapped_of(fitted, scene), si, mi.Bool(True))
    looked_up = np.array(place.cell(table, mi.Vector3f)).T
    expected, _ = at_points(fitted.maps, strands, fitted.root_uv)
    off = np.abs(looked_up - expected[strands.segment_starts]).max(axis=1)
    assert np.mean(off < 2e-3) > 0.99  # the others are of strands that were respaced for the spline


def mapped_of(fitted, scene):
    from appearance.bsdf.maps import MappedStrands

    return MappedStrands.of(scene, fitted.strands, fitted.root_uv).coordinates


def test_cut_strands_end_where_they_were_cut_and_keep_their_colours_in_place(fitted):
    length = 0.035
    known = np.linspace(0, 1, len(fitted.strands.points), dtype=np.float32)
    short = cut(replace(fitted, strands=replace(fitted.strands, confidence=known)), length)
    np.testing.assert_array_equal(
        short.strands.confidence[short.strands.offsets[:-1]], known[fitted.strands.offsets[:-1]]
    )
    assert (fitted.strands.lengths() > length).all()
    np.testing.assert_allclose(short.strands.lengths(), length, rtol=1e-4)
    np.testing.assert_array_equal(short.strands.roots, fitted.strands.roots)
    # a tip has the colour that was there, 8 evenly spaced points a strand before
    before, after = (at_points(m.maps, m.strands, m.root_uv)[0] for m in (fitted, short))
    at = 7 * length / fitted.strands.lengths()
    low = fitted.strands.offsets[:-1] + at.astype(int)
    share = (at % 1)[:, None]
    there = before[low] * (1 - share) + before[low + 1] * share
    # nearly: strands of one cell share its colours and differ in length
    assert np.median(np.abs(after[short.strands.offsets[1:] - 1] / there - 1)) < 0.05
    assert (
        np.median(before[fitted.strands.offsets[1:] - 1] / there) > 1.3
    )  # those that were cut off
    with pytest.raises(ValueError, match="above 0"):
        cut(fitted, 0)
    long = cut(fitted, 1.0)
    np.testing.assert_array_equal(long.strands.points, fitted.strands.points)
    np.testing.assert_allclose(long.maps.sigma_a, fitted.maps.sigma_a)


def test_other_strands_take_the_place_of_the_nearest_root(fitted):
    few = fitted.strands.subset([7, 3])
    np.testing.assert_array_equal(restyled(fitted, few).root_uv, fitted.root_uv[[7, 3]])
    assert restyled(fitted, few).scene().hair == fitted.maps.mean()
    with pytest.raises(ValueError, match="needs strands"):
        restyled(fitted, fitted.strands.subset([]))


def test_lights_are_as_found_where_they_were_fitted(fitted, model, small):
    front, behind, _ = small.lights()
    copy = Model(model.path.parent / "found")
    fitted.save(copy)
    save_lights(copy, np.array([0.5]), [front])
    rig = Rig("r", (CAMERA,), (front, behind))
    capture = SimpleNamespace(rig=rig, head=None)
    ours, calibrated = FittedModel.load(copy, capture).lights(["front", "behind"])
    np.testing.assert_allclose(ours.intensity, 0.5 * front.intensity)
    np.testing.assert_array_equal(calibrated.intensity, behind.intensity)
    with pytest.raises(ValueError, match="capture"):
        fitted.lights(["front"])
