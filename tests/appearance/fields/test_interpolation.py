"""Photobooth's reflectance field against samples whose answers are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from appearance.bsdf.maps import MappedStrands, scalp_coordinates
from appearance.fields.hits import HitOptions, find_hits
from appearance.fields.interpolation import HITS, Interpolation, irradiance
from appearance.fields.kajiya_kay import KajiyaKay
from appearance.fields.neighbours import camera_weights, kriging_weights, light_weights
from appearance.fields.reflectance import CapturedView, ReflectanceField
from appearance.fields.search import DIFFUSE, EXPONENT, blocks, searched, worst_block
from appearance.model.interpolated import environment_lights, panel
from appearance.render.environment_maps import studio
from appearance.render.mixed import Environment
from appearance.scene.hair_appearance import HairAppearance
from appearance.scene.hair_scene import build_scene
from reconstruction import Camera, Light, Stage
from reconstruction.geometry.lights import dome_positions

TRUE = KajiyaKay(DIFFUSE[3], EXPONENT[8])


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def camera(angle_deg, name, size=20, distance=0.6):
    a = np.radians(angle_deg)
    place = distance * np.array([np.sin(a), -np.cos(a), 0.2])
    return Camera.look_at(name, size, size, place, (0, 0, 0), fov_deg=9)


def lamps(count=60):
    spots = dome_positions(count, 1.0, lowest_deg=-20)
    return tuple(Light(f"l{i}", p, np.full(3, 4.0 + i % 3)) for i, p in enumerate(spots))


def kajiya_kay_picture(hits, light, model=TRUE, albedo=0.3):
    """Radiance `(P, 3)` of fibres that reflect as `model` says, without shadows."""
    point, weight = hits.column("point"), hits.column("weight")
    toward = unit(light.position - point)
    found = model(hits.column("tangent"), hits.towards_camera(), toward)
    mean = (found * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-9)
    return albedo * mean[:, None] * irradiance(light, hits.middle())


@pytest.fixture(scope="module")
def tuft(small):
    strands = small.tuft(300)
    uv = scalp_coordinates(strands, None)
    scene = build_scene(strands, None, hair=HairAppearance((0.2, 0.3, 0.5), 0.3, 0.3))
    return strands, MappedStrands.of(scene, strands, uv)


@pytest.fixture(scope="module")
def planted(tuft):
    """An interpolation of frames that are `TRUE`'s, from three cameras."""
    strands, mapped = tuft
    lights, views = lamps(), []
    for k, angle in enumerate((-40, 0, 40)):
        view = camera(angle, f"cam_{k}")
        pixels = np.arange(view.width * view.height)
        many = find_hits(mapped, view, pixels, HitOptions(32))
        pixels = pixels[many.column("weight").sum(axis=1) > 0.8]
        hits = find_hits(mapped, view, pixels, HITS)
        table = np.stack([kajiya_kay_picture(hits, x) for x in lights])
        views.append(CapturedView(view, pixels, table.astype(np.float16)))
    field = ReflectanceField(lights, tuple(views), 1.0)
    return Interpolation.of(field, mapped, strands)


def error(made, truth):
    return float(np.sqrt(((made - truth) ** 2).sum() / (truth**2).sum()))


def relit_error(interpolation, light, number=1):
    hits = interpolation.sources[number].hits
    made, known = interpolation.at_hits(hits).under([light])
    assert (known > 0).all()
    return error(made[0], kajiya_kay_picture(hits, light))


def test_the_true_model_reproduces_its_own_frames_and_standard_interpolation_does_not(planted):
    light = Light("new", unit(np.array([0.35, -0.8, 0.4])), np.full(3, 5.0))
    exact = replace(planted, model=TRUE, floor=0.0)
    assert relit_error(exact, light) < 2e-3  # halves
    assert relit_error(planted, light) > 0.02
    # a bounded gain gives part of that away
    assert relit_error(exact, light) < relit_error(replace(exact, floor=0.3), light)
    assert relit_error(replace(exact, floor=0.3), light) < relit_error(planted, light)


def test_a_captured_light_is_reproduced_from_a_captured_camera(planted):
    hits = planted.sources[0].hits
    for model in (None, KajiyaKay(0.1, 30.0)):
        one = replace(planted, model=model)
        made, _ = one.at_hits(hits).under([one.field.lights[17]])
        table = one.sources[0].view.table[17].astype(float)
        np.testing.assert_allclose(made[0], table, rtol=4e-3, atol=1e-3 * table.max())


def test_twice_as_far_or_twice_as_bright(planted):
    hits, spot = planted.sources[1].hits, unit(np.array([0.2, -0.7, 0.5]))
    lit = [
        planted.at_hits(hits).under([Light("x", r * spot, np.full(3, i))])[0]
        for r, i in ((200.0, 8.0), (200.0, 16.0), (400.0, 8.0))
    ]
    np.testing.assert_allclose(lit[1], 2 * lit[0], rtol=1e-4)
    np.testing.assert_allclose(lit[2], lit[0] / 4, rtol=5e-3)


def test_between_cameras_the_true_model_beats_standard_interpolation(planted, tuft):
    _, mapped = tuft
    between = camera(20, "between")
    pixels = planted.sources[1].view.pixels
    hits = find_hits(mapped, between, pixels, HITS)
    light = Light("new", unit(np.array([0.1, -0.9, 0.5])), np.full(3, 5.0))
    truth = kajiya_kay_picture(hits, light)
    errors = {}
    for name, model in (("standard", None), ("true", TRUE)):
        view = replace(planted, model=model, floor=0.05).at_hits(hits)
        made, known = view.under([light])
        good = known[0] > 0.9
        assert good.sum() > 30
        errors[name] = error(made[0][good], truth[good])
    assert errors["true"] < 0.8 * errors["standard"]


def test_search_finds_planted_parameters_and_records_them(planted):
    found = searched(replace(planted, floor=0.0), ["l9", "l20"], cameras=1)
    assert (found.best.diffuse, found.best.exponent) == (TRUE.diffuse, TRUE.exponent)
    stage = Stage("x")
    found.record(stage)
    assert stage.figures["exponent_range"] == [TRUE.exponent, TRUE.exponent]
    assert stage.figures["worst_block"] < 0.1 * stage.figures["worst_block_standard"]
    assert stage.warnings == []


def test_search_warns_where_standard_interpolation_is_as_good(planted):
    dull = []
    for source in planted.sources:
        points = source.hits.middle()
        table = np.stack([0.3 * irradiance(x, points) for x in planted.field.lights])
        dull.append(replace(source, view=replace(source.view, table=table.astype(np.float16))))
    found = searched(replace(planted, sources=tuple(dull)), ["l9"], cameras=1)
    stage = Stage("x")
    found.record(stage)
    assert any("standard interpolation" in w for w in stage.warnings)


@pytest.mark.slow
def test_search_is_judged_by_frames_that_are_there(planted):
    """A frame that did not come is no picture without an error: other cameras' frames say."""
    whole = replace(planted, sources=planted.sources[:2])
    source = whole.sources[1]
    table = source.view.table.copy()
    table[9] = np.nan
    lost = replace(source, view=replace(source.view, table=table))
    found = searched(replace(whole, sources=(whole.sources[0], lost)), ["l9", "l20"])
    alone = searched(replace(whole, sources=whole.sources[:1]), ["l9", "l20"])
    both = searched(whole, ["l9", "l20"])
    np.testing.assert_allclose(found.errors[0], alone.errors[0])
    np.testing.assert_allclose(found.errors[1], both.errors[1])
    assert found.standard[0] == pytest.approx(alone.standard[0])
    nowhere = replace(whole, sources=(lost,))
    assert searched(nowhere, ["l9", "l20"]).lights == ("l20",)
    with pytest.raises(ValueError, match="l9"):
        searched(nowhere, ["l9"])


def test_search_and_pictures_are_of_one_mind(planted):
    """The search's fast sums against the pictures themselves."""
    one = replace(planted, sources=planted.sources[:1])
    found = searched(one, ["l9"], cameras=1)
    rest, hits = one.without(lights=["l9"]), one.sources[0].hits
    model = KajiyaKay(DIFFUSE[2], EXPONENT[5])
    made, _ = replace(rest, model=model).at_hits(hits).under([one.field.lights[9]])
    truth = one.sources[0].view.table[9].astype(float)
    block = blocks(one.sources[0].view.pixels, 20)
    expected = worst_block(made[0] - truth, block) / worst_block(truth, block)
    assert found.errors[0, 2, 5] == pytest.approx(expected, rel=0.02)


def test_points_outside_all_cameras_are_unknown_and_black(planted, tuft):
    _, mapped = tuft
    behind = camera(180, "behind")
    hits = find_hits(mapped, behind, np.arange(400), HITS)
    view = planted.at_hits(hits)
    hair = hits.column("weight").sum(axis=1)
    assert view.known.sum() < 0.9 * hair.sum()
    made, known = view.under([planted.field.lights[3]])
    assert np.isfinite(made).all()
    assert (made[0][known[0] == 0] == 0).all()


def test_missing_and_saturated_samples_weigh_nothing(planted):
    source = planted.sources[1]
    table = source.view.table.copy()
    light = Light("new", 1.01 * planted.field.lights[9].position, np.full(3, 5.0))
    near = planted.neighbours([light])[0][0]
    table[near[:3]] = np.nan
    table[:, 5] = np.nan
    view = replace(source.view, table=table)
    some = replace(planted, sources=(replace(source, view=view),), model=TRUE, floor=0.0)
    made, known = some.at_hits(source.hits).under([light])
    truth = kajiya_kay_picture(source.hits, light)
    assert known[0, 5] == 0
    assert (made[0, 5] == 0).all()
    rest = np.arange(len(truth)) != 5
    assert error(made[0][rest], truth[rest]) < 5e-3


def test_under_all_lights_half_of_the_light_is_not_all_of_it(planted):
    """A pixel that is saturated under one of two lights is not known, or its highlight is black."""
    source, two = planted.sources[1], [planted.field.lights[k] for k in (9, 40)]
    table = source.view.table.copy()
    near, other = planted.neighbours(two)[0]
    assert not set(near) & set(other)
    table[near, 5] = np.nan
    some = replace(planted, sources=(replace(source, view=replace(source.view, table=table)),))
    whole, known = some.at_hits(source.hits).under_all(two)
    assert known[5] == 0
    truth = sum(kajiya_kay_picture(source.hits, x) for x in two)
    assert error(whole[known > 0], truth[known > 0]) < 5e-3
    assert (np.delete(known, 5) > 0).all()


def test_black_frames_and_dark_lights(planted):
    source = planted.sources[1]
    black = replace(source.view, table=np.zeros_like(source.view.table))
    some = replace(planted, sources=(replace(source, view=black),), model=TRUE)
    made, known = some.at_hits(source.hits).under([planted.field.lights[3]])
    assert (made == 0).all()
    assert (known > 0).all()
    off = tuple(replace(x, intensity=np.zeros(3)) for x in planted.field.lights)
    dark = replace(planted, field=replace(planted.field, lights=off))
    _, known = dark.at_hits(source.hits).under([planted.field.lights[3]])
    assert (known == 0).all()  # samples of lights that were off say nothing


def test_moved_strands_keep_their_samples(planted, tuft):
    """Hair, cameras and lights turned together look the same."""
    strands, _ = tuft
    a = np.radians(25)
    turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    moved = strands.transformed(turn, np.zeros(3))
    scene = build_scene(moved, None, hair=HairAppearance((0.2, 0.3, 0.5), 0.3, 0.3))
    mapped = MappedStrands.of(scene, moved, scalp_coordinates(strands, None))
    own = planted.sources[1].view.camera
    hits = find_hits(mapped, own.moved(turn.T, np.zeros(3)), planted.sources[1].view.pixels, HITS)
    light = Light("new", unit(np.array([0.35, -0.8, 0.4])), np.full(3, 5.0))
    there = Light("there", turn @ light.position, light.intensity)
    model = replace(planted, model=TRUE, floor=0.05)
    made, known = model.at_hits(hits).under([there])
    expected, _ = model.at_hits(planted.sources[1].hits).under([light])
    good = known[0] > 0.9
    assert good.sum() > 30
    assert error(made[0][good], expected[0][good]) < 0.35  # seen by one camera, from another place


class TestNeighbours:
    def test_a_camera_has_itself(self):
        directions = unit(np.random.default_rng(0).normal(size=(12, 3)))
        for k in range(12):
            np.testing.assert_allclose(
                camera_weights(directions, directions[k]), np.eye(12)[k], atol=1e-7
            )

    def test_barycentric_on_an_octahedron(self):
        axes = np.concatenate([np.eye(3), -np.eye(3)])
        weights = camera_weights(axes, unit(np.array([1.0, 2.0, 5.0])))
        np.testing.assert_allclose(weights, np.array([1, 2, 5, 0, 0, 0]) / 8, atol=1e-6)

    def test_outside_of_all_triangles_the_nearest_edge_or_camera(self):
        three = unit(np.array([[1.0, 0, 0], [1, 1, 0], [1, 0.5, 0.5]]))
        down = camera_weights(three, unit(np.array([1.0, 0.4142, -0.3])))
        assert down[2] == 0
        assert down[0] == pytest.approx(0.5, abs=0.01)
        np.testing.assert_allclose(camera_weights(three, np.array([0, -1.0, 0])), [1, 0, 0])

    def test_one_and_two_cameras(self):
        two = np.eye(3)[:2]
        np.testing.assert_allclose(camera_weights(two[:1], np.array([0, 0, 1.0])), [1])
        np.testing.assert_allclose(camera_weights(two, unit(np.array([1.0, 1, 0]))), [0.5, 0.5])

    def test_equal_lights_share_and_rows_sum_to_one(self):
        directions = unit(dome_positions(20, 1.0))
        both = np.concatenate([directions, directions[:1]])
        order, weights = light_weights(both, directions[:1])
        found = np.zeros(21)
        found[order[0]] = weights[0]
        assert found[0] == pytest.approx(0.5, abs=1e-3)
        assert found[20] == pytest.approx(0.5, abs=1e-3)
        _, weights = light_weights(both, unit(np.random.default_rng(0).normal(size=(50, 3))))
        np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=1e-5)
        assert (weights >= 0).all()

    def test_kriging_by_hand_and_of_captured_and_equal_lights(self):
        """On an arc a value at the middle is the mean; beyond the end it is the end's."""
        a = np.radians([0.0, 20.0, 40.0])
        arc = np.stack([np.cos(a), np.sin(a), 0 * a], -1)
        towards = np.radians([30.0, 60.0])
        new = np.stack([np.cos(towards), np.sin(towards), 0 * towards], -1)
        near, weights = kriging_weights(arc, new[0])
        np.testing.assert_allclose(weights[np.argsort(near)], [0, 0.5, 0.5], atol=1e-6)
        near, weights = kriging_weights(arc, new[1])
        np.testing.assert_allclose(weights[np.argsort(near)], [0, 0, 1], atol=1e-6)
        near, weights = kriging_weights(arc, arc[1])
        assert (near.tolist(), weights.tolist()) == ([1], [1.0])
        twice, weights = kriging_weights(arc[[0, 0, 2]], new[0])
        np.testing.assert_allclose(weights[np.argsort(twice)], [0.125, 0.125, 0.75], atol=1e-6)

    def test_one_light_alone(self):
        _, weights = light_weights(np.eye(3)[:1], unit(np.ones((1, 3))))
        np.testing.assert_allclose(weights, [[1]], rtol=1e-6)


class TestEnvironments:
    def test_a_uniform_map_is_the_sphere(self):
        """The irradiance of radiance 1 from all sides on a point, as a sum over lights: 4 pi."""
        lights = environment_lights(Environment(np.ones((24, 48, 3), np.float32)))
        total = sum(irradiance(x, np.zeros((1, 3))) for x in lights)
        np.testing.assert_allclose(total, 4 * np.pi, rtol=1e-4)

    @pytest.mark.parametrize("shape", [(1, 1), (3, 5)])
    def test_a_uniform_map_of_few_texels_shines_from_all_sides(self, shape):
        """By symmetry no side of it is brighter: its vector irradiance is 0."""
        lights = environment_lights(Environment(np.ones((*shape, 3), np.float32)))
        each = np.array([irradiance(x, np.zeros((1, 3)))[0, 0] for x in lights])
        assert each.sum() == pytest.approx(4 * np.pi, rel=1e-4)
        ways = np.array([unit(x.position) for x in lights])
        np.testing.assert_allclose(each @ ways, 0, atol=0.05)

    def test_a_single_texel_shines_from_where_it_is(self):
        envmap = np.zeros((32, 64, 3), np.float32)
        envmap[16, 32] = (1, 2, 3)  # below the horizon by half a texel, +x
        (light,) = environment_lights(Environment(envmap, rotation_deg=90.0))
        np.testing.assert_allclose(unit(light.position), [0.05, 1, -0.05], atol=0.01)

    def test_the_whole_map_is_the_sum_of_its_lights(self, planted):
        sky = Environment(studio(32))
        view = replace(planted, model=TRUE).at_hits(planted.sources[1].hits)
        lights = environment_lights(sky, rows=6)
        whole, _ = view.under_all(lights)
        single = sum(view.under([x])[0][0] for x in lights)
        np.testing.assert_allclose(whole, single, rtol=1e-4)

    def test_a_panel_keeps_its_light(self):
        aim = np.eye(3)
        light = Light("p", np.zeros(3), np.full(3, 2.0), orientation=aim, size=(0.2, 0.1))
        far = np.array([[0.3, 0.2, 4.0]])
        total = sum(irradiance(x, far) for x in panel(light))
        np.testing.assert_allclose(total, irradiance(light, far), rtol=2e-3)
