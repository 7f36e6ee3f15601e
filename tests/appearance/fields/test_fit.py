"""Fields are found back where they were planted, and say nothing where nothing was seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from appearance.fields.anchors import Grid, Places, nested
from appearance.fields.basis import ViewBasis
from appearance.fields.fit import Monitor, fit_pictures
from appearance.fields.form import Form
from appearance.fields.grams import Gram, Samples
from appearance.fields.hits import HitOptions, find_hits
from appearance.fields.options import FieldOptions
from appearance.fields.solver import LeastSquares, ViewSystem, conjugate_gradients
from appearance.fields.validation import Folds, _elsewhere
from appearance.render.coverage import coverage
from appearance.render.harmonics import harmonics
from reconstruction import BadOptions, Light, parse_options
from reconstruction.files import durable

LEVELS = ((2, 3, 3), (4, 6, 6))
EXACT = FieldOptions(
    "modulation",
    degree=1,
    levels=LEVELS,
    ridges=(1e-5, 1e-3, 0.1),
    tolerance=1e-4,
    iterations=100,
    folds=2,
)
ROUGH = replace(EXACT, levels=LEVELS[:1], tolerance=1e-2, iterations=15)
"""Where the answer does not ask for the minimum."""


def fitted(planted, views, options=EXACT, monitor=None):
    return fit_pictures(views, planted.places, planted.scale, options, monitor)


@pytest.mark.parametrize(
    "kind",
    [*(pytest.param(k, marks=pytest.mark.slow) for k in ("modulation", "additive")), "whole"],
)
def test_a_planted_field_is_found_back(planted, kind):
    truth = planted.truth(kind)
    views = planted.views(truth)
    options = replace(EXACT, kind=kind, ridges=(1e-7, 1e-5))
    found = fitted(planted, views, options)
    assert found.decision.kept
    assert found.decision.after < 0.4 * found.decision.before
    far = [replace(x, position=2 * x.position, intensity=4 * x.intensity) for x in views[0].lights]
    for view in views[::2]:
        wanted, have = (f.at(view.hits).lit(view.halves[0], far) for f in (truth, found.field))
        np.testing.assert_allclose(have.sum(0), wanted.sum(0), rtol=0.04, atol=0.002 * wanted.max())


def test_the_gram_is_the_error_of_the_pictures_it_was_made_of(planted):
    """Against the sum over pixels and lights, written out."""
    view = planted.views(planted.truth(degree=2), 6)[0]
    view.valid[2, ::3] = False
    samples = view.samples(replace(EXACT, degree=2), planted.scale)
    gram = Gram.of(samples, 2)
    rng = np.random.default_rng(0)
    g = 0.2 * rng.normal(size=(len(view.hits.pixels), 9, 3)).astype(np.float32)

    def error(g):
        total = 0.0
        for i, light in enumerate(view.lights):
            y = harmonics(light.position - view.hits.middle(), 2)
            shown = view.halves[0, i] * planted.scale * (1 + np.einsum("pn,pnc->pc", y, g))
            off = (shown - view.captured[i] * planted.scale) ** 2 * samples.weight[i]
            total += float(off[view.valid[i]].sum())
        return total

    change = np.sum(g * (gram.times(g[..., None])[..., 0] - 2 * gram.right), dtype=float)
    assert change == pytest.approx(error(g) - error(0 * g), rel=1e-4)
    assert samples.weight[2, ::3].max() == 0


@pytest.mark.parametrize("strands", [True, False])
def test_pixels_and_anchors_are_transposes(planted, strands):
    view = planted.views(planted.truth(), 4)[1]
    grid = Grid.of((3, 4, 4), len(planted.strands))
    basis = ViewBasis.of(view.hits, grid, planted.places, 2, in_strands=strands)
    rng = np.random.default_rng(1)
    x = rng.normal(size=(grid.count, 9 * 9 * 3)).astype(np.float32)
    g = rng.normal(size=(len(view.hits.pixels), 9, 3)).astype(np.float32)
    one, other = (basis.at_pixels(x) * g).sum(), (x * basis.at_anchors(g)).sum()
    assert one == pytest.approx(other, rel=1e-3, abs=0.05)


@pytest.mark.parametrize("kind", ["modulation", "additive"])
def test_pixels_without_hair_get_no_field(planted, kind):
    field = planted.truth(kind)
    camera = planted.views(field, 4)[0].hits.camera
    bare = np.flatnonzero((coverage(planted.mapped.scene, camera)["hair"] == 0).ravel())[:5]
    found = field.at(find_hits(planted.mapped, camera, bare, HitOptions(8)))
    assert found.coefficients.shape == (5, 4, 3)
    assert not found.coefficients.any()


def test_coarse_grids_say_on_the_finest_what_they_say_by_themselves(planted):
    grids = [Grid.of(level, 300) for level in ((2, 2, 2), (3, 4, 4))]
    up = nested(grids, planted.places)
    rng = np.random.default_rng(0)
    coarse = rng.normal(size=grids[0].count).astype(np.float32)
    fine = up @ np.concatenate([coarse, np.zeros(grids[1].count, np.float32)])
    strand, along = rng.integers(300, size=50), rng.uniform(size=50)

    def at(grid, values):
        low, high, share = grid.near(strand, along, planted.places)
        return (1 - share) * values[low] + share * values[high]

    np.testing.assert_allclose(at(grids[1], fine), at(grids[0], coarse), atol=1e-6)


def system_of(planted, views, ridge, degree=1):
    options = replace(EXACT, degree=degree)
    grids = [Grid.of(level, len(planted.strands)) for level in LEVELS]
    samples = [v.samples(options, planted.scale) for v in views]
    observed = [
        ViewSystem(
            ViewBasis.of(v.hits, grids[-1], planted.places, degree, in_strands=True),
            [Gram.of(s, degree)],
        )
        for v, s in zip(views, samples, strict=True)
    ]
    return LeastSquares(
        observed, nested(grids, planted.places), Form("modulation", degree), ridge
    ), samples


def test_conjugate_gradients_solve_the_normal_equations(planted):
    system, _ = system_of(planted, planted.views(planted.truth(), 4)[:2], 0.03)
    found = conjugate_gradients(system, 200, 1e-5)
    right = system.right()
    np.testing.assert_allclose(system.times(found), right, atol=1e-3 * np.abs(right).max())


def test_folds_solved_at_once_are_what_they_are_one_by_one(planted):
    """Against each fold's own least squares, of only the views and lights that it is fitted to."""
    views = planted.views(planted.truth(), 6)
    system, samples = system_of(planted, views, 0.01)
    folds = Folds((0, 1, 2, 0, 1), (0, 1, 0, 1, 0, 1))
    parts = [
        [Gram.of(s.under(folds.lights_of(part)), 1) for part in range(folds.of_lights)]
        for s in samples
    ]
    fits = [
        [tuple(f for f in range(6) if folds.is_fitted(f, v, part)) for part in (0, 1)]
        for v in range(len(views))
    ]
    bases = [observed.basis for observed in system.views]
    block = [ViewSystem(*each) for each in zip(bases, parts, fits, strict=True)]
    at_once = conjugate_gradients(replace(system, views=block, fits=6), 200, 1e-4)
    for fold in range(6):
        view, light = divmod(fold, 2)
        lights = folds.lights_of(1 - light)
        alone = [
            ViewSystem(bases[v], [Gram.of(samples[v].under(lights), 1)])
            for v in range(len(views))
            if folds.views[v] != view
        ]
        wanted = conjugate_gradients(replace(system, views=alone, known={}), 200, 1e-4)
        found = at_once.reshape(*wanted.shape, 6)[..., fold]
        np.testing.assert_allclose(found, wanted, atol=2e-3 * np.abs(wanted).max())


def test_a_ridge_without_end_leaves_the_pictures_as_they_are(planted):
    views = planted.views(planted.truth())
    found = fitted(planted, views, replace(ROUGH, ridges=(1e12,)))
    lit = found.field.at(views[0].hits).lit(views[0].halves[0], views[0].lights)
    np.testing.assert_allclose(lit, views[0].halves[0], rtol=1e-4, atol=1e-6)
    assert any("strongest ridge" in w.lower() for w in found.warnings)
    none = fitted(planted, views, replace(ROUGH, ridges=(1e-20,)))
    assert np.isfinite(none.field.values).all()
    assert any("weakest ridge" in w.lower() for w in none.warnings)


def test_anchors_that_no_camera_sees_are_zero(planted):
    views = planted.views(planted.truth())
    options = replace(ROUGH, levels=((4, 6, 6),), ridges=(1e-3,))
    found = fitted(planted, views, options)
    observed = set()
    for view in views:
        strand = view.hits.column("strand")
        on = strand >= 0
        grid = Grid.of((4, 6, 6), 300)
        low, high, share = grid.near(
            strand[on].astype(int), view.hits.column("along")[on], planted.places
        )
        observed |= set(low[share < 1]) | set(high[share > 0])
    assert set(found.field.rows) <= observed
    assert len(observed) < 4 * 36, "some cells have no strand in sight"


def test_odd_data_give_a_field_or_a_sentence(planted):
    views = planted.views(planted.truth())

    def cut(lights, cameras=5):
        return [v.under(lights) for v in views[:cameras]]

    for nothing in (cut([3], 1), []):
        with pytest.raises(ValueError, match="no frame can be held out"):
            fitted(planted, nothing, ROUGH)
    assert fitted(planted, cut([3]), ROUGH).decision.standard_error is not None
    twins = fitted(planted, cut([0, 0, 1, 1, 2, 2, 3, 3]), ROUGH)
    assert np.isfinite(twins.field.values).all()
    saturated = [replace(v, valid=np.zeros_like(v.valid)) for v in views]
    assert not fitted(planted, saturated, ROUGH).field.values.any()
    # pixels that are black without the field say nothing, and no number is lost over them
    black = [
        replace(v, halves=np.where(np.arange(16)[:, None, None] < 8, v.halves, np.float32(0)))
        for v in views
    ]
    dark = fitted(planted, black, ROUGH)
    assert np.isfinite(dark.field.values).all()
    assert (dark.field.at(views[0].hits).lit(black[0].halves[0], black[0].lights)[8:] == 0).all()
    inside = tuple(Light(x.name, 0.01 * x.position, 1e-4 * x.intensity) for x in views[0].lights)
    near = fitted(planted, [replace(v, lights=inside) for v in views], ROUGH)
    assert np.isfinite(near.field.values).all()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_field_is_kept_for_what_is_there_and_not_for_noise(planted, seed):
    """Frames with noise of 10 %: of a field that is there, and of none."""
    rng = np.random.default_rng(seed)
    options = replace(ROUGH, ridges=(1e-3, 1e-2, 0.1, 1.0, 10.0), folds=3)
    gains = []
    for there in (True, False):
        views = planted.views(planted.truth())
        noisy = []
        for v in views:
            frames = v.captured if there else v.halves[0]
            noise = 1 + 0.1 * rng.normal(size=frames.shape)
            noisy.append(replace(v, captured=np.maximum(frames * noise, 0).astype(np.float32)))
        found = fitted(planted, noisy, options)
        assert found.decision.kept == there
        field = found.field.at(views[0].hits).lit(views[0].halves[0], views[0].lights)
        wanted = views[0].captured if there else views[0].halves[0]
        off = [float(((x - wanted) ** 2).mean()) for x in (field, views[0].halves[0])]
        gains.append(off[0] - off[1])
    assert gains[0] < 0


def test_the_noise_of_rendered_pictures_does_not_pull_a_field_to_zero():
    """A factor of 1.5 on light that is rendered with 50 % of noise: regression dilution, 1.2."""
    rng, lights = np.random.default_rng(3), (Light("a", np.array([0, 0, 1.0]), np.ones(3)),)
    light = rng.uniform(0.5, 1, (1, 4000, 3))
    halves = (light * rng.gamma(4, 0.25, (2, *light.shape))).astype(np.float32)
    factors = []
    for two in (halves, halves[[0, 0]]):
        targets = (1.5 * light - two).astype(np.float32)
        even = np.ones(light.shape, np.float32)
        gram = Gram.of(Samples(lights, np.zeros((4000, 3)), two, targets, even), 0)
        factors.append(1 + harmonics((0, 0, 1.0), 0)[0] * gram.right.sum() / gram.packed.sum())
    assert factors[0] == pytest.approx(1.5, rel=0.02)
    assert factors[1] == pytest.approx(1.2, rel=0.02), "one half twice"


def test_a_picture_has_no_part_in_the_ridge_at_which_it_is_judged():
    """Errors of two ridges: the weaker halves all of them, but for one picture that it spoils.

    The other pictures show that the weaker ridge is better than the stronger, and than no field.
    """
    folds = Folds((0, 1, 2), (0, 1, 2))
    without, counts = np.zeros((2, 9, 3, 3, 9))
    for fold, view, light in np.ndindex(9, 3, 3):
        if folds.is_judged(fold, view, light):
            without[fold, view, light] = 1 + 0.1 * view + 0.1 * light
            counts[fold, view, light] = 10
    assert (counts.sum(axis=0) == 10).all(), "each picture is judged once"
    strong, weak = 0.9 * without, 0.5 * without
    weak[:, 0, 0] = 200 * without[:, 0, 0]
    judged = _elsewhere(np.stack([without, strong, weak]), counts, folds, 0)
    np.testing.assert_array_equal(judged, weak[0])


def per_view(planted, seed, noise=0.05):
    """Each view has a factor of its own, by which images of new views cannot gain."""
    rng = np.random.default_rng(seed)
    out = []
    for view in planted.views(planted.truth()):
        c = 0.2 * rng.normal(size=(1, 4, 3))
        y = [harmonics(x.position - view.hits.middle(), 1) for x in view.lights]
        factor = 1 + np.einsum("lpn,xnc->lpc", y, c)
        frames = view.halves[0] * factor * (1 + noise * rng.normal(size=factor.shape))
        out.append(replace(view, captured=np.maximum(frames, 0).astype(np.float32)))
    return out


@pytest.mark.parametrize(
    "wrong", [{"ridges": []}, {"levels": []}, {"levels": [[4, 0, 3]]}], ids=str
)
def test_options_that_no_fit_could_have_are_refused_before_it(wrong):
    with pytest.raises(BadOptions):
        parse_options(FieldOptions, wrong, "fit")


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_factors_of_single_views_are_dropped(planted, seed):
    """Fitted to some views it is wrong in others, whose factors were drawn on their own."""
    options = replace(ROUGH, ridges=(1e-2, 0.1, 1.0), folds=3)
    found = fitted(planted, per_view(planted, seed), options)
    assert not found.decision.kept


def test_saturated_pixels_weigh_nothing(planted):
    views = planted.views(planted.truth())
    spoilt = []
    for v in views:
        bad = np.random.default_rng(0).uniform(size=v.valid.shape) < 0.2
        captured = np.where(bad[..., None], 50.0, v.captured)
        spoilt.append(replace(v, captured=captured.astype(np.float32), valid=~bad))
    found = fitted(planted, spoilt, replace(EXACT, iterations=40))
    assert found.decision.after < 0.5 * found.decision.before


def test_frames_that_no_factor_explains_give_a_warning(planted):
    """Black frames under half of the lights: a smooth factor undershoots there."""
    views = planted.views(planted.truth())
    x = np.array([light.position[0] for light in views[0].lights])
    lit = np.where(x > 0, 1, 0)[:, None, None] * np.ones(3)
    half = [replace(v, captured=(v.halves[0] * lit).astype(np.float32)) for v in views]
    found = fitted(planted, half, replace(ROUGH, degree=2))
    assert found.clamped > 0.01
    assert any("negative modulation" in w for w in found.warnings)
    assert found.decision.after < found.decision.before


def test_killed_fit_resumes_after_its_finished_ridges(planted, tmp_path):
    views = planted.views(planted.truth())

    def killed(what, share):
        if what.startswith("ridge 0.001: error"):
            raise KeyboardInterrupt

    options = replace(ROUGH, ridges=(1e-5, 1e-3, 0.1, 10.0))
    checkpoint = tmp_path / "field.checkpoint.npz"
    with pytest.raises(KeyboardInterrupt):
        fitted(planted, views, options, Monitor(killed, checkpoint))
    again = []
    found = fitted(planted, views, options, Monitor(lambda w, s: again.append(w), checkpoint))
    assert not [w for w in again if w.startswith(("ridge 10", "ridge 0.1"))]
    whole = fitted(planted, views, options)
    assert found.tried == whole.tried
    np.testing.assert_array_equal(found.field.values, whole.field.values)


def shifted(view, by):
    """The view in a world whose origin is elsewhere; its first three pixels are off the hair."""
    table = view.hits.table.copy()
    table[:3] = np.zeros(1, table.dtype)
    table["strand"][:3] = -1
    table["point"][3:] += by.astype(np.float32)
    hits = replace(view.hits, camera=view.hits.camera.moved(np.eye(3), -by), table=table)
    lights = tuple(replace(x, position=x.position + by) for x in view.lights)
    return replace(view, hits=hits, lights=lights)


@pytest.mark.parametrize("kind", ["modulation", "additive"])
def test_a_field_does_not_depend_on_where_the_origin_is(planted, kind):
    """A light is there: pixels off the hair are not, for that."""
    views = planted.views(planted.truth(kind), 8)[:2]
    options = replace(ROUGH, kind=kind, ridges=(0.1,))
    here, there = np.zeros(3), -views[0].lights[2].position
    one, other = (fitted(planted, [shifted(v, by) for v in views], options) for by in (here, there))
    largest = np.abs(one.field.values).max()
    np.testing.assert_allclose(other.field.values, one.field.values, atol=2e-3 * largest)
    for name in ("before", "after"):
        errors = [getattr(found.decision, name) for found in (one, other)]
        assert errors[1] == pytest.approx(errors[0], rel=1e-2)
    lit, moved = (
        f.field.at(v.hits).lit(v.halves[0], v.lights)
        for f, v in ((one, shifted(views[0], here)), (other, shifted(views[0], there)))
    )
    np.testing.assert_allclose(moved, lit, rtol=1e-3, atol=1e-3 * lit.max())


def test_a_checkpoint_is_on_the_disk_before_it_replaces_the_one_before_it(
    planted, tmp_path, monkeypatch
):
    views, done = planted.views(planted.truth()), []
    options = replace(ROUGH, ridges=(1e-3, 0.1, 10.0))
    folder = tmp_path / "work"

    def full(path):
        if done:
            raise OSError(28, "No space left on device")
        done.append(path)

    with monkeypatch.context() as patched:
        patched.setattr(durable, "flush", full)
        with pytest.raises(OSError, match="No space left"):
            fitted(planted, views, options, Monitor(checkpoint=folder / "field.npz"))
    assert [f.name for f in folder.iterdir()] == ["field.npz"]
    again = []
    progress_monitor = Monitor(lambda w, s: again.append(w), folder / "field.npz")
    fitted(planted, views, options, progress_monitor)
    ridges = {w.split(":")[0] for w in again if w.startswith("ridge") and "error" in w}
    assert ridges == {"ridge 0.1", "ridge 0.001"}, "the first was kept"


def test_places_of_edited_strands():
    grid, places = (
        Grid.of((3, 2, 2), 4),
        Places.of(np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]])),
    )
    low, high, share = grid.near(np.array([1]), np.array([0.75]), places)
    assert (low[0], high[0], share[0]) == (4 + 2, 8 + 2, 0.5)
    cut = Places(places.root_uv, np.full(4, 0.5), places.fitted)
    assert grid.near(np.array([1]), np.array([1.0]), cut)[0][0] == 4 + 2
    assert Grid.of((8, 0, 0), 4).near(np.array([3]), np.array([0.0]), places)[0][0] == 3
