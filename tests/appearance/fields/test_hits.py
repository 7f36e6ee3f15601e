"""First hits: where they lie, what they say of the strand, and that they are made once."""

from __future__ import annotations

import numpy as np
import pytest

from appearance import HairAppearance, build_scene
from appearance.bsdf.maps import MappedStrands, scalp_coordinates
from appearance.fields import hits as hits_module
from appearance.fields.hits import HitOptions, find_hits
from appearance.render.coverage import coverage, covered_pixels
from reconstruction import Camera, Strands

HAIR = HairAppearance((0.2, 0.3, 0.5), 0.3, 0.3)


def mapped_of(strands: Strands, head=None) -> MappedStrands:
    return MappedStrands.of(
        build_scene(strands, head, hair=HAIR), strands, scalp_coordinates(strands, head)
    )


@pytest.fixture(scope="module")
def rod() -> MappedStrands:
    """One straight strand of 2 mm radius, 10 cm along z from its root at z = -5 cm."""
    z = np.linspace(-0.05, 0.05, 11)
    points = np.stack([0 * z, 0 * z, z], -1).astype(np.float32)
    return mapped_of(Strands(points, np.array([0, 11]), 2e-3))


def test_hits_on_a_rod_lie_where_the_rays_meet_it(rod):
    camera = Camera.look_at("front", 9, 33, (0, -0.5, 0), (0, 0, 0), fov_deg=4)
    pixels = covered_pixels(rod.scene, camera)
    hits = find_hits(rod, camera, pixels, HitOptions(64))
    shown = coverage(rod.scene, camera, 256)["hair"].ravel()[pixels] > 0.1
    on_hair = hits.column("strand") >= 0
    point, along = hits.column("point")[on_hair], hits.column("along")[on_hair]
    assert shown.any()
    assert on_hair[shown].any(axis=1).all()
    np.testing.assert_allclose(np.hypot(point[:, 0], point[:, 1]), 2e-3, rtol=0.02)
    np.testing.assert_allclose(along, (point[:, 2] + 0.05) / 0.1, atol=2e-3)
    np.testing.assert_allclose(hits.column("tangent")[on_hair], [[0, 0, 1]] * len(point), atol=1e-3)
    normal = hits.column("normal")[on_hair]
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(normal, normal[:1].repeat(len(normal), 0), atol=1e-4)
    # the hits of a pixel project into it
    where, depth = camera.project(hits.column("point"))
    column, row = pixels % 9, pixels // 9
    assert (depth[on_hair] > 0).all()
    off = np.abs(where - np.stack([column, row], -1)[:, None])[on_hair]
    assert off.max() < 0.51


def test_weights_add_up_to_the_share_of_a_pixel_that_shows_hair(small):
    mapped = mapped_of(small.tuft(), small.ball((0.03, 0.03, 0.03)))
    camera = small.camera()
    pixels = covered_pixels(mapped.scene, camera)
    hits = find_hits(mapped, camera, pixels, HitOptions(64))
    share = coverage(mapped.scene, camera, 256)["hair"].ravel()[pixels]
    # 64 jittered rays against 256
    assert np.abs(hits.column("weight").sum(1) - share).max() < 0.2
    assert np.abs(hits.column("weight").sum(1) - share).mean() < 0.02
    strand, weight = hits.column("strand"), hits.column("weight")
    assert ((strand >= 0) == (weight > 0)).all()
    assert (strand < 0).any()
    # the frame is that of the strand's own points about the place
    tangents = small.tuft().tangents().reshape(-1, 8, 3)
    on = strand >= 0
    near = np.rint(hits.column("along")[on] * 7).astype(int)
    cosine = (tangents[strand[on], near] * hits.column("tangent")[on]).sum(-1)
    assert np.quantile(cosine, 0.01) > 0.97
    cross = (hits.column("normal")[on] * hits.column("tangent")[on]).sum(-1)
    assert np.abs(cross).max() < 1e-4
    middle = hits.middle()
    assert np.linalg.norm(middle, axis=1).max() < 0.06
    off = middle[~on.any(1)]
    np.testing.assert_allclose(
        off, np.broadcast_to(hits.column("point")[on].mean(0), off.shape), atol=1e-5
    )


def test_places_stay_when_the_hair_moves(small):
    """Turned about z, strands and camera alike: the same (strand, along)."""
    strands = small.tuft()
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = Strands((strands.points @ turn.T).astype(np.float32), strands.offsets, strands.radius)
    one, other = mapped_of(strands), mapped_of(moved)
    camera = small.camera()
    center = turn @ np.array([0.0, -0.5, 0.1])
    turned = Camera.look_at("turned", 24, 24, center, (0, 0, 0), fov_deg=10)
    pixels = np.arange(200, 400)
    a = find_hits(one, camera, pixels, HitOptions(4))
    b = find_hits(other, turned, pixels, HitOptions(4))
    same = a.column("strand") == b.column("strand")
    assert same.mean() > 0.97  # a ray that grazes a fibre may miss it after rounding
    on = same & (a.column("strand") >= 0)
    np.testing.assert_allclose(a.column("along")[on], b.column("along")[on], atol=2e-3)
    np.testing.assert_allclose(a.column("normal")[on] @ turn.T, b.column("normal")[on], atol=2e-2)


def test_hits_are_made_once_for_what_they_depend_on(small, tmp_path, monkeypatch):
    mapped, camera, pixels = mapped_of(small.tuft()), small.camera(), np.arange(250, 330)
    first = find_hits(mapped, camera, pixels, HitOptions(4), tmp_path)
    in_memory = find_hits(mapped, camera, pixels, HitOptions(4))
    np.testing.assert_array_equal(np.asarray(first.table), in_memory.table)
    assert isinstance(first.table, np.memmap)
    traced = []
    trace = hits_module._trace
    monkeypatch.setattr(hits_module, "_trace", lambda *a: (traced.append(1), trace(*a)))
    again = find_hits(mapped, camera, pixels, HitOptions(4), tmp_path)
    np.testing.assert_array_equal(np.asarray(again.table), in_memory.table)
    assert not traced
    find_hits(mapped, camera, pixels, HitOptions(4, seed=1), tmp_path)
    find_hits(mapped, camera, pixels[1:], HitOptions(4), tmp_path)
    find_hits(mapped_of(small.tuft(seed=1)), camera, pixels, HitOptions(4), tmp_path)
    assert len(traced) == 3
    with pytest.raises(ValueError, match="flat indices"):
        find_hits(mapped, camera, [24 * 24])
