"""Highlights that are at wrong places, for directions that are off, are moved by turns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from appearance import HairAppearance, build_scene, render_olat
from appearance.bsdf.maps import HairMaps, MappedStrands, scalp_coordinates
from appearance.fields.anchors import Places
from appearance.fields.field import Field
from appearance.fields.fit import fit_pictures
from appearance.fields.hits import HitOptions, find_hits
from appearance.fields.options import FieldOptions
from appearance.fields.pictures import Pictures
from appearance.fields.turns import turning_features
from appearance.render.coverage import coverage
from appearance.render.harmonics import harmonics
from reconstruction import Camera, Light, Model, ModelError
from reconstruction.geometry.lights import dome_positions

HAIR = HairAppearance((0.06, 0.12, 0.3), 0.3, 0.3)
TURN = 0.12
"""Radians by which all fibres are turned about one of their normals."""
OPTIONS = FieldOptions("turns", levels=((2, 2, 2),), ridges=(1e-3, 1e-2, 0.1))


@pytest.fixture(scope="module")
def turned(small):
    """Views of fibres that are turned by `TURN`, beside pictures of fibres that are not."""
    strands = small.tuft(300)
    scene = build_scene(strands, None, hair=HAIR)
    mapped = MappedStrands.of(scene, strands, scalp_coordinates(strands, None))
    maps = HairMaps.of(HAIR)
    true = mapped.with_maps(replace(maps, rotation=maps.rotation + np.array((TURN, 0.0))))
    lights = tuple(
        Light(f"l{i}", p, np.full(3, 5.0)) for i, p in enumerate(dome_positions(24, 1.0))
    )
    views = []
    for k, a in enumerate(np.arange(5) * 2 * np.pi / 5):
        place = (0.5 * np.cos(a), 0.5 * np.sin(a), 0.1)
        camera = Camera.look_at(f"c{k}", 16, 16, place, (0, 0, 0), 12)
        pixels = np.flatnonzero((coverage(scene, camera)["hair"] > 0.7).ravel())

        def shown(of, seed, spp=64, camera=camera, pixels=pixels):
            return render_olat(
                of, camera, lights, spp=spp, max_depth=1, pixels=pixels, seed=seed, thrift=0
            )

        captured = shown(true, 3 * k, 512)
        halves = np.stack([shown(scene, 3 * k + 1), shown(scene, 3 * k + 2)])
        valid = np.ones(captured.shape[:2], bool)
        hits = find_hits(mapped, camera, pixels, HitOptions(8))
        views.append(Pictures(hits, lights, halves, captured, valid))
    return views, Places.of(mapped.root_uv)


def test_turned_fibres_are_found_and_their_highlights_moved(turned):
    """What was turned is known; a factor of each place alone does not bring it."""
    views, places = turned
    found, factor = (
        fit_pictures(views, places, 3.0, replace(OPTIONS, kind=kind, degree=0))
        for kind in ("turns", "modulation")
    )
    for group in ("new lights", "new views", "both new"):
        turns, plain = (f.validation[group] for f in (found, factor))
        gain = turns["with"] - turns["without"]
        assert gain > 0.7, group
        assert gain > 2 * turns["spread"], group
        assert plain["with"] - plain["without"] < 0.3, group
    assert not found.doubts()
    angles = 0.15 * found.field.values.reshape(-1, 3, 3)[:, 1:].mean(axis=(0, 2))
    size = float(np.linalg.norm(angles))
    assert size == pytest.approx(TURN, rel=0.35)
    assert np.abs(angles).max() > 0.9 * size, "about one of the two normals"


def test_features_turn_with_the_hair_and_are_nothing_off_it(turned):
    views, _ = turned
    hits = views[0].hits
    rng = np.random.default_rng(0)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    table = hits.table.copy()
    for name in ("point", "tangent", "normal"):
        table[name] = hits.table[name] @ turn.T
    moved = Camera.look_at("moved", 16, 16, turn @ hits.camera.center, (0, 0, 0), 12)
    one = turning_features(hits, 0.3)
    other = turning_features(replace(hits, camera=moved, table=table), 0.3)
    light = rng.normal(size=(50, 3))
    a = one @ harmonics(light, 3).T
    b = other @ harmonics(light @ turn.T, 3).T
    np.testing.assert_allclose(a[:, 0], 1, atol=1e-5)
    assert np.abs(a - b).mean() < 0.1 * np.abs(a[:, 1:]).mean()
    table["strand"], table["weight"] = -1, 0
    assert not turning_features(replace(hits, table=table), 0.3)[:, 1:].any()


def test_a_field_of_turns_is_read_as_it_was_written(turned, tmp_path):
    views, places = turned
    field = fit_pictures(views, places, 3.0, OPTIONS).field
    model = Model(tmp_path / "model").create()
    field.save(model)
    again = Field.load(model)
    assert (again.kind, again.beta_m) == ("turns", OPTIONS.beta_m)
    hits = views[1].hits
    np.testing.assert_array_equal(field.at(hits).coefficients, again.at(hits).coefficients)
    for wrong in (np.nan, 0.0, 2.0):
        replace(field, beta_m=wrong).save(model)
        with pytest.raises(ModelError, match="turns of beta_m"):
            Field.load(model)
