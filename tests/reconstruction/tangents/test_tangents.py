"""3D directions from several cameras' lines, and from reflection."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from reconstruction import Camera, Light
from reconstruction.geometry.lights import dome_positions
from reconstruction.tangents.estimate import _visible, at_most
from reconstruction.tangents.line_evidence import (
    LineEvidence,
    Tangents,
    decide,
    deviation_deg,
    finer,
    half_sphere,
    line_scores,
    line_support,
    visible_from,
)
from reconstruction.tangents.pooling import pool
from reconstruction.tangents.reflection import (
    OlatStack,
    Reflection,
    learned,
    observe,
    surface_normals,
)

BINS = 36


def camera(position: tuple[float, float, float]) -> Camera:
    return Camera.look_at("cam", 64, 64, position, (0, 0, 0), 20.0)


def image_angle(c: Camera, point: np.ndarray, direction: np.ndarray) -> float:
    a, b = c.project(np.stack([point - 1e-4 * direction, point + 1e-4 * direction]))[0]
    return float(np.arctan2(*(b - a)[::-1]))


def evidence_of(c: Camera, direction: np.ndarray) -> LineEvidence:
    """At the origin: support that peaks at the angle at which `direction` appears there."""
    angles = np.arange(BINS) * np.pi / BINS
    peak = np.cos(angles - image_angle(c, np.zeros(3), direction)) ** 40
    support = np.broadcast_to((peak - peak.mean())[:, None, None], (BINS, 64, 64))
    return LineEvidence.of(c, support.astype(np.float32), np.zeros((1, 3)), np.array([True]))


def degrees_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(np.abs((a * b).sum(axis=-1)), 0, 1)))


def test_half_sphere_is_even() -> None:
    d = half_sphere(500)
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1)
    cosine = np.abs(d @ d.T) - np.eye(500)
    nearest = np.degrees(np.arccos(cosine.max(axis=1)))
    assert nearest.min() > 2.5
    assert nearest.max() < 6.5


@pytest.mark.parametrize("direction", [(0.2, 0.3, 0.9), (0.6, 0.6, -0.3), (-0.5, 0.2, 0.8)])
def test_cameras_fix_a_direction(direction: tuple[float, float, float]) -> None:
    t = np.array(direction) / np.linalg.norm(direction)
    candidates = half_sphere(2000)
    scores = np.zeros((1, 2000), np.float32)
    for position in ((1.0, -0.3, 0.1), (0.3, -1.0, 0.3), (0.7, -0.7, 0.6)):
        e = evidence_of(camera(position), t)
        scores += line_scores(e, candidates)
    found = decide(scores, candidates)
    assert degrees_between(found.directions[0], t) < 6  # the support is 13 degrees wide
    assert found.confidence[0] > 0.5


@pytest.mark.parametrize("offset", [0.0, 0.2, 0.37, 0.5])
@pytest.mark.parametrize("count", [11, 24])
def test_peaks_between_two_angles_of_the_bank_are_found(count: int, offset: float) -> None:
    true = (5 + offset) * np.pi / count
    away = np.cos(2 * (np.arange(count) * np.pi / count - true))
    fine = finer(np.exp(2 * away)[None])[0]
    peak = fine.argmax() * np.pi / len(fine)
    assert np.degrees(abs(peak - true)) <= 90 / len(fine) + 1e-6  # half of its own spacing
    at = np.cos(2 * (np.arange(len(fine)) * np.pi / len(fine) - true))
    np.testing.assert_allclose(fine, np.exp(2 * at), atol=0.01)


def test_one_camera_leaves_a_plane() -> None:
    candidates = half_sphere(1000)
    t = np.array([0.0, 0.0, 1.0])
    e = evidence_of(camera((0.0, -1.0, 0.0)), t)
    one = decide(line_scores(e, candidates), candidates)
    # In the plane of line and ray only the weight differs, the squared sine to the ray along y.
    plane = np.array([t, [0, 0.6, 0.8], [0, -0.6, 0.8], [1, 0, 0]])
    score = line_scores(e, plane)[0]
    assert score[1:3] == pytest.approx(0.64 * score[0], rel=1e-4)
    assert score[3] < 0
    two = evidence_of(camera((1.0, 0.0, 0.0)), t)
    both = line_scores(e, candidates) + line_scores(two, candidates)
    assert decide(both, candidates).confidence[0] > one.confidence[0]


def test_a_line_along_the_ray_is_not_spoken_about() -> None:
    c = camera((0.0, -1.0, 0.0))
    e = evidence_of(c, np.array([0.0, 0.0, 1.0]))
    along = line_scores(e, np.array([[0.0, 1.0, 0.0]]))
    assert abs(along[0, 0]) < 1e-6


@pytest.mark.parametrize("deg", [1.0, 6.0, 12.0])
def test_deviation_is_that_of_the_directions_that_a_confidence_describes(deg: float) -> None:
    """Drawn from a normal distribution about an axis; confidence as `Tangents` defines it."""
    turns = np.random.default_rng(0).normal(0, np.radians(deg), (200_000, 2))
    drawn = np.column_stack([np.tan(turns), np.ones(len(turns))])
    drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
    values = np.linalg.eigvalsh(drawn.T @ drawn / len(drawn))
    assert deviation_deg(values[2] - values[1]) == pytest.approx(deg, rel=0.05)
    assert deviation_deg([1, 0]) == pytest.approx([0, np.degrees(3**-0.5)])


def test_no_texture_gives_no_confidence() -> None:
    support = line_support(np.ones((8, 4, 4)))
    assert np.abs(support).max() == 0
    candidates = half_sphere(50)
    assert decide(np.zeros((3, 50), np.float32), candidates).confidence.max() == 0


def test_points_behind_the_visible_surface_are_hidden() -> None:
    c = camera((0.0, -1.0, 0.0))
    depth = np.full((64, 64), np.linalg.norm(c.center))
    depth[:, 48:] = 0  # nothing is known there
    points = np.array([[0, 0, 0], [0, 0.003, 0], [0, 0.02, 0], [5.0, 0, 0], [0, -3.0, 0]])
    assert visible_from(c, depth, points, 4e-3).tolist() == [True, True, False, False, False]
    pixels = np.array([[47.0, 30.0], [49.0, 30.0]])
    assert visible_from(c, depth, c.center + c.rays(pixels), 4e-3).tolist() == [True, False]


def test_pooling_averages_over_near_points_only() -> None:
    points = np.array([[0, 0, 0], [1e-3, 0, 0], [0.1, 0, 0]])
    table = pool(points, 5e-3).toarray()
    np.testing.assert_allclose(table.sum(axis=1), 1)
    assert table[0, 1] > 0.3
    assert table[0, 2] == 0
    assert table[2, 2] == 1


def test_points_that_cameras_see_through_are_dropped() -> None:
    """A point 3 cm in front of the surface that both cameras show behind it, and one on it."""
    cameras = [camera((0.0, -1.0, 0.0)), camera((0.05, -1.0, 0.0))]
    depths = [np.full((64, 64), 1.0)] * 2
    points = np.array([[0.0, -0.03, 0.0], [0.0, 0.0, 0.0]])
    kept, visible = _visible(points, cameras, depths, 2e-3)
    np.testing.assert_array_equal(kept, points[1:])
    assert visible.all()


def test_a_fly_away_that_one_of_two_cameras_resolves_is_kept() -> None:
    """It is visible in that camera only: the other shows the surface behind it."""
    cameras = [camera((0.0, -1.0, 0.0)), camera((0.05, -1.0, 0.0))]
    depths = [np.full((64, 64), 0.97), np.full((64, 64), 1.0)]
    kept, visible = _visible(np.array([[0.0, -0.03, 0.0]]), cameras, depths, 2e-3)
    assert len(kept) == 1
    assert visible.tolist() == [[True, False]]


def turning_patch(full: float = np.inf, missing: int = 0):
    """Points of a patch, their directions, which turn, and what two cameras saw of them.

    The highlight is cut off at `full` of its height; so many frames are `missing`.
    """
    lights = [Light(f"l{i}", p, np.ones(3)) for i, p in enumerate(dome_positions(200, 1.2))]
    cameras = [
        Camera.look_at(f"c{i}", 48, 48, p, (0, 0, 0), 12.0)
        for i, p in enumerate([(0.9, -0.2, 0.1), (0.8, 0.4, 0.2)])
    ]
    y, z = (a.ravel() for a in np.meshgrid(*[np.linspace(-0.05, 0.05, 24)] * 2))
    points = np.stack([np.zeros_like(y), y, z], axis=1)
    angle = 12 * y + 8 * z
    truth = np.stack([0.2 * np.ones_like(y), np.sin(angle), np.cos(angle)], axis=1)
    truth /= np.linalg.norm(truth, axis=1, keepdims=True)
    pictures = []
    positions = np.stack([light.position for light in lights])
    for c in cameras:
        away = positions[None] - points[:, None]
        far = np.linalg.norm(away, axis=2, keepdims=True)
        to_camera = c.center - points
        to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
        sines = np.einsum("pld,pd->pl", away / far, truth)
        s = sines + (to_camera * truth).sum(axis=1, keepdims=True)
        profile = 0.15 + np.exp(-(s**2) / (2 * 0.3**2))
        profile = profile * np.maximum((away / far)[..., 0], 0.02) / far[..., 0] ** 2
        x_, y_ = np.rint(c.project(points)[0]).astype(int).T
        image = np.zeros((len(lights), 48, 48))
        image[:, y_, x_] = profile.T
        clipped = image >= full * image.max()
        image = np.where(clipped, 0.3 * image.max(), image)  # as if there had never been more
        image[:missing] = 0
        known = ~clipped
        known[:missing] = False
        pictures.append(OlatStack(c, image, known))
    every = np.ones(len(points), bool)
    normals = surface_normals(points, np.mean([c.center for c in cameras], axis=0) - points)
    return points, truth, [observe(p, lights, points, normals, every) for p in pictures]


def reflection_scores(observed_directions, points, candidates, known):
    """Scores of all cameras by the table that the known directions fill, and that table."""
    table = learned(observed_directions, known)
    scores = np.zeros((len(points), len(candidates)), np.float32)
    for o in observed_directions:
        scores[o.index] += table.scores(o, points, candidates)
    return scores, table


@pytest.mark.parametrize(("full", "missing"), [(np.inf, 0), (0.5, 0), (np.inf, 10)])
def test_reflection_finds_directions_that_texture_does_not_know(full, missing) -> None:
    """A patch whose direction turns from point to point; a third of the points are known.

    As well where highlights are cut off at half of their height, and where frames are missing.
    """
    points, truth, observed_directions = turning_patch(full, missing)
    rng = np.random.default_rng(3)
    first = truth.copy()
    wrong = rng.random(len(points)) > 0.45
    first[wrong] = rng.normal(size=(int(wrong.sum()), 3))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    candidates = half_sphere(800)
    known = Tangents(first, np.where(wrong, 0.1, 0.9))
    scores, table = reflection_scores(observed_directions, points, candidates, known)
    assert table.contrast > 2
    error = degrees_between(decide(scores, candidates).directions, truth)
    assert np.median(error) < 4
    assert np.median(error[wrong]) < 4
    assert (error < 15).mean() > 0.9


def test_a_table_filled_anew_brings_directions_nearer() -> None:
    """Directions 18 degrees off blur the table; those that it tells fill it sharper."""
    points, truth, observed_directions = turning_patch()
    scatter = np.tan(np.radians(15)) * np.random.default_rng(3).normal(size=truth.shape)
    first = (truth + scatter) / np.linalg.norm(truth + scatter, axis=1, keepdims=True)
    candidates = half_sphere(800)
    known, errors = Tangents(first, np.ones(len(points))), []
    for _ in range(2):
        scores, _ = reflection_scores(observed_directions, points, candidates, known)
        known = decide(scores, candidates)
        errors.append(np.median(degrees_between(known.directions, truth)))
    assert errors[1] < 0.7 * errors[0]
    assert errors[1] < 4


def test_normals_face_the_viewer() -> None:
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.random((200, 2)), np.zeros(200)])
    towards = np.tile([0.1, 0.2, -1.0], (200, 1))
    np.testing.assert_allclose(
        surface_normals(plane, towards), np.tile([0, 0, -1.0], (200, 1)), atol=1e-9
    )


def test_observations_undo_distance_and_intensity() -> None:
    """A matte point stack to near and far, weak and strong lamps alike."""
    c = camera((1.0, 0.0, 0.0))
    lights = [
        Light("a", np.array([1.0, 0.2, 0]), np.full(3, 2.0)),
        Light("b", np.array([2.0, -0.4, 0]), np.full(3, 5.0)),
    ]
    cosines = np.array([1 / np.hypot(1, 0.2), 1 / np.hypot(1, 0.2)])
    far2 = np.array([1.04, 4.16])
    olat = (np.array([2.0, 5.0]) * cosines / far2)[:, None, None] * np.ones((2, 64, 64))
    visible = np.array([True])
    o = observe(
        OlatStack(c, olat, np.ones(olat.shape, bool)),
        lights,
        np.zeros((1, 3)),
        np.array([[1.0, 0, 0]]),
        visible,
    )
    np.testing.assert_allclose(o.response, 1, rtol=1e-5)
    np.testing.assert_allclose(o.towards(slice(None))[1][0], cosines, rtol=1e-6)


def test_a_lamp_that_gives_no_light_says_nothing() -> None:
    """Of a matte point the other lamps' stack stay 1, whatever noise its frame holds."""
    c = camera((1.0, 0.0, 0.0))
    lights = [
        Light(n, np.array([1.0, y, 0]), np.full(3, i)) for n, y, i in (("a", 0, 1), ("b", 1, 0))
    ]
    olat = np.array([1.0, 1e-3])[:, None, None] * np.ones((2, 64, 64))
    stack = OlatStack(c, olat, np.ones(olat.shape, bool))
    point, normal = np.zeros((1, 3)), np.array([[1.0, 0, 0]])
    o = observe(stack, lights, point, normal, np.array([True]))
    assert o.known.tolist() == [[True, False]]
    assert o.response[0, 0] == pytest.approx(1)


def test_more_points_than_fit_are_measured_further_apart() -> None:
    """A square of 0.1 m: as many cells as the limit are 2 mm wide."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(0, 0.1, (200_000, 2)), np.zeros((200_000, 1))], axis=1)
    found, apart = at_most(2_500, points, 1e-3)
    assert len(found) <= 2_500
    assert 2e-3 <= apart < 2.2e-3
    found, apart = at_most(10_201, points, 1e-3)
    assert apart == 1e-3
    assert len(found) == pytest.approx(10_000, rel=1e-3)
    assert at_most(0, np.zeros((0, 3)), 1e-3)[1] == 1e-3


def test_a_flat_table_has_no_contrast() -> None:
    assert Reflection(np.ones(8), np.ones(72)).contrast == pytest.approx(1)


@pytest.mark.slow
def test_scores_are_made_and_decided_without_many_times_their_memory() -> None:
    """Of 20 megapixels there are half a million points: 1 GB of scores, 10 GB beside them."""
    rng = np.random.default_rng(0)
    points, candidates = rng.normal(size=(80_000, 3)) * 0.01, half_sphere(100)
    camera = Camera.look_at("c", 64, 64, (0, -1, 0), (0, 0, 0), 10.0)
    support = rng.random((24, 64, 64), np.float32)
    evidence = LineEvidence.of(camera, support, points, np.ones(len(points), bool))
    tracemalloc.start()
    scores = line_scores(evidence, candidates)
    of_making = tracemalloc.get_traced_memory()[1]
    tracemalloc.reset_peak()
    decide(scores, candidates)
    of_deciding = tracemalloc.get_traced_memory()[1] - scores.nbytes
    near = pool(points, 1e-3, 8)
    tracemalloc.reset_peak()
    before = tracemalloc.get_traced_memory()[0]
    _ = near @ scores
    of_averaging = tracemalloc.get_traced_memory()[1] - before
    tracemalloc.stop()
    assert of_making < 5 * scores.nbytes
    assert of_deciding < 2 * scores.nbytes
    assert of_averaging < 1.5 * scores.nbytes  # the means themselves, and no copy


def test_views_that_see_noise_do_not_outvote_one_that_sees_the_highlight() -> None:
    points, truth, (view, *_) = turning_patch()
    table = Reflection.learn([view], truth, np.ones(len(points), bool))
    rng, candidates = np.random.default_rng(5), half_sphere(800)
    noise = [rng.uniform(0, 2, view.response.shape).astype(np.float32) for _ in range(4)]
    views = [view, *(replace(view, response=n) for n in noise)]
    scores = np.sum([table.scores(o, points, candidates) for o in views], axis=0)
    error = degrees_between(decide(scores, candidates).directions, truth)
    assert np.median(error) < 2.5
