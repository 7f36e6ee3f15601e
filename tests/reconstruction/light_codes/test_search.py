"""Depths of known fibres, by lightcodes and without, and the search's edge cases."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from reconstruction.light_codes.lmvs import LmvsSearch
from reconstruction.light_codes.search import DepthMap, DepthSearch, narrowed
from reconstruction.reconstruct_options import SearchOptions


def error(stage: Any, view: int, found: DepthMap) -> Any:
    """Depth errors, millimetres."""
    return 1e3 * np.abs(found.depth - stage.depth(view)[found.y, found.x])


@pytest.mark.parametrize("method", [DepthSearch, LmvsSearch])
def test_depths_are_true_below_a_pixel(fibres: Any, method: type[DepthSearch]) -> None:
    found = method(fibres.views, (0, 0, 0)).run(1, *fibres.range(1))
    assert len(found.x) > 0.85 * fibres.views[1].mask.sum()
    pixel = 1e3 * fibres.depth(1).max() / fibres.cameras[1].K[0, 0]
    assert np.median(error(fibres, 1, found)) < pixel
    observed = fibres.drawn[1]
    ahead = fibres.cameras[1].project(observed.point[found.y, found.x] + 1e-5 * found.direction)[0]
    flow = ahead - fibres.cameras[1].project(observed.point[found.y, found.x])[0]
    angle = np.arctan2(flow[:, 1], flow[:, 0]) - observed.angle[found.y, found.x]
    off = np.degrees(np.abs((angle + np.pi / 2) % np.pi - np.pi / 2))
    assert np.median(off) < 8


@pytest.mark.slow
def test_fine_pictures_are_searched_in_fine_steps(make_fibres: Any, fibre_cameras: Any) -> None:
    """Pixels of 0.13 mm: by steps of 0.5 mm, 0.82 of the depths are right within two of them."""
    stage = make_fibres(cameras=fibre_cameras(8, 576))
    found = DepthSearch(stage.views, (0, 0, 0)).run(1, *stage.range(1))
    pixel = 1e3 * stage.depth(1).max() / stage.cameras[1].K[0, 0]
    assert (error(stage, 1, found) < 2 * pixel).mean() > 0.85


def test_two_stages_find_what_brute_force_finds(fibres: Any) -> None:
    brute, quick = (
        DepthSearch(fibres.views, (0, 0, 0), options).run(0, *fibres.range(0))
        for options in (SearchOptions(candidates=k, lattice=1) for k in (0, 24))
    )
    maps = np.full((2, *fibres.views[0].mask.shape), np.nan)
    for depths, found in zip(maps, (brute, quick), strict=True):
        depths[found.y, found.x] = found.depth
    same = np.abs(maps[0] - maps[1]) < 1.25e-4
    assert same.sum() > 0.98 * max(len(brute.x), len(quick.x))


def test_pixels_between_those_of_a_lattice_are_searched_where_these_found_hair() -> None:
    """A slope with a tenth of wild depths on the lattice; one corner has too few to tell."""
    rng = np.random.default_rng(4)
    size, apart = 80, 4
    y, x = np.mgrid[:size, :size]
    true = (1 + 1e-4 * x + 5e-5 * y).astype(np.float32)
    at = np.arange(apart // 2, size, apart)
    ly, lx = (a.ravel() for a in np.meshgrid(at, at, indexing="ij"))
    keep = (ly > 24) | (lx > 24)
    ly, lx = ly[keep], lx[keep]
    depth = true[ly, lx] + np.where(rng.random(len(ly)) < 0.1, rng.uniform(-0.02, 0.02, len(ly)), 0)
    none = np.zeros(len(ly), np.float32)
    found = DepthMap(lx, ly, depth.astype(np.float32), none[:, None], none, none, none, none)
    near, far = true - 0.03, true + 0.03
    nearer, further = narrowed(found, near, far, apart)
    inside = (nearer <= true) & (true <= further)
    assert inside.mean() > 0.98
    assert np.median(further - nearer) < 0.1 * 0.06
    np.testing.assert_array_equal(nearer[:8, :8], near[:8, :8])
    np.testing.assert_array_equal(further[:8, :8], far[:8, :8])


def test_lights_beside_cameras_determine_visibility_of_a_pixel(fibres: Any) -> None:
    search = DepthSearch(fibres.views, (0, 0, 0))
    y, x = np.nonzero(fibres.views[0].mask)
    sees = search.visible(0, y, x)
    points = fibres.drawn[0].point[y, x]
    for n, k in enumerate(search.neighbours[0]):
        facing = (points * (fibres.cameras[k].center - points)).sum(axis=1) > 0
        assert not sees[~facing, n].any()
    assert 0.3 < sees.mean() < 0.9


def test_without_a_light_beside_a_camera_its_neighbours_count_as_seeing(fibres: Any) -> None:
    views = [replace(v, beside=-1) for v in fibres.views]
    search = DepthSearch(views, (0, 0, 0))
    y, x = np.nonzero(views[0].mask)
    assert search.visible(0, y, x).all()
    found = search.run(0, *fibres.range(0))
    assert np.median(error(fibres, 0, found)) < 0.4


def test_two_identical_cameras_give_no_depth(make_fibres: Any, fibre_cameras: Any) -> None:
    one = fibre_cameras(3)[0]
    stage = make_fibres(cameras=[one, replace(one, name="twin")])
    found = DepthSearch(stage.views, (0, 0, 0)).run(0, *stage.range(0))
    assert len(found.x) == 0  # all planes are parallel


def test_one_view_is_refused_and_cameras_across_have_no_neighbours(
    fibres: Any, make_fibres: Any, stage_camera: Callable[..., Any]
) -> None:
    with pytest.raises(ValueError, match="at least two views"):
        DepthSearch(fibres.views[:1], (0, 0, 0))
    across = make_fibres(cameras=[stage_camera("a", 0.0), stage_camera("b", 180.0)])
    search = DepthSearch(across.views, (0, 0, 0))
    assert search.neighbours == [[], []]
    assert len(search.run(0, *across.range(0)).x) == 0


def test_a_mask_of_one_pixel_has_at_most_one_segment(fibres: Any) -> None:
    mask = np.zeros_like(fibres.views[0].mask)
    y, x = np.argwhere(fibres.views[0].mask)[50]
    mask[y, x] = True
    views = [replace(fibres.views[0], mask=mask), *fibres.views[1:]]
    found = DepthSearch(views, (0, 0, 0)).run(0, *fibres.range(0))
    assert len(found.x) <= 1
    empty = [replace(fibres.views[0], mask=np.zeros_like(mask)), *fibres.views[1:]]
    assert len(DepthSearch(empty, (0, 0, 0)).run(0, *fibres.range(0)).x) == 0


def test_many_lights_fill_several_words(make_fibres: Any, fibre_lamps: Any) -> None:
    """100 lights: four words a pixel, counts far beyond 16."""
    stage = make_fibres()
    stage = make_fibres(lights=fibre_lamps(100, stage.cameras))
    assert stage.views[0].codes.words.shape[-1] == 4
    found = DepthSearch(stage.views, (0, 0, 0)).run(0, *stage.range(0))
    assert np.median(error(stage, 0, found)) < 0.35


def test_a_single_light_leaves_the_lines(make_fibres: Any, fibre_lamps: Any) -> None:
    stage = make_fibres(lights=fibre_lamps(1))
    found = DepthSearch(stage.views, (0, 0, 0)).run(0, *stage.range(0))
    assert np.median(error(stage, 0, found)) < 1.0
