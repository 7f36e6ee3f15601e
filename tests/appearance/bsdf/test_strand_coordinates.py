"""Frames that travel along strands, and the place of a point on a spline's segment."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from appearance.bsdf.strand_coordinates import (
    place_in_segment,
    strand_parameters,
    transported_normals,
)


def helices(strands: int = 5, points: int = 400, turns: float = 2.0):
    """Control points `(N, 3)`, segments, and segments per strand, of helices of varied pitch."""
    t = np.linspace(0, 2 * np.pi * turns, points)
    pitch = np.linspace(0.05, 0.5, strands)[:, None]
    curves = np.stack(np.broadcast_arrays(np.cos(t), np.sin(t), pitch * t), -1)
    first = np.arange(strands)[:, None] * points + np.arange(points - 3)
    return curves.reshape(-1, 3), first.ravel(), np.full(strands, points - 3)


def tangents(points, segments):
    d = points[segments + 3] - points[segments]
    d = d + 5 * (points[segments + 2] - points[segments + 1])
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def test_normals_stay_perpendicular_and_do_not_turn_about_the_strand():
    """Against a helix's own frame they turn back by its torsion, c/√(1 + c²) for a pitch c."""
    points, segments, counts = helices()
    along = tangents(points, segments)
    normals = transported_normals(points, segments, counts)
    assert np.abs((normals * along).sum(-1)).max() < 1e-12
    assert np.linalg.norm(normals, axis=-1) == pytest.approx(1, abs=1e-12)
    each = counts[0]
    for s, pitch in enumerate(np.linspace(0.05, 0.5, 5)):
        n, t = normals[s * each : (s + 1) * each], along[s * each : (s + 1) * each]
        angle = np.linspace(0, 4 * np.pi, 400)
        middle = 0.5 * (angle[1:-2] + angle[2:-1])
        inward = -np.stack([np.cos(middle), np.sin(middle), 0 * middle], -1)
        turned = np.unwrap(np.arctan2((np.cross(t, inward) * n).sum(-1), (inward * n).sum(-1)))
        torsion = pitch / np.hypot(1, pitch)
        assert turned[-1] - turned[0] == pytest.approx(
            -torsion * (middle[-1] - middle[0]), rel=1e-3
        )


def test_frames_move_with_the_head():
    points, segments, counts = helices(points=30)
    roots = np.cross(tangents(points, segments)[:: counts[0]], [0.0, 0, 1])
    before = transported_normals(points, segments, counts, roots)
    turn = Rotation.from_rotvec([0.3, -1.2, 0.7])
    after = transported_normals(turn.apply(points), segments, counts, turn.apply(roots))
    assert after == pytest.approx(turn.apply(before), abs=1e-9)


def test_strands_of_any_length_and_direction_have_frames():
    counts = np.array([1, 7, 2, 30])
    ends = np.array([[0, 0, -1.0], [0, 0, 1], [1, 0, 0], [-1, 0, 1e-9]])
    points, segments, start = [], [], 0
    for count, end in zip(counts, ends, strict=True):
        t = np.arange(count + 3)[:, None]
        points.append(t * end)
        segments.append(start + np.arange(count))
        start += count + 3
    points, segments = np.concatenate(points), np.concatenate(segments)
    normals = transported_normals(points, segments, counts)
    assert np.linalg.norm(normals, axis=-1) == pytest.approx(1)
    assert np.abs((normals * tangents(points, segments)).sum(-1)).max() < 1e-9


def test_the_nearest_place_on_a_segment_and_its_tangent():
    rng = np.random.default_rng(2)
    n = 2000
    control = np.arange(4)[:, None] * [0.05, 0, 0] + rng.normal(scale=0.01, size=(n, 4, 3))
    v = rng.uniform(0, 1, (n, 1))
    w = 1 - v
    basis = np.hstack([w**3, 3 * v**3 - 6 * v**2 + 4, 3 * w**3 - 6 * w**2 + 4, v**3]) / 6
    derivative = np.hstack([-(w**2), 3 * v**2 - 4 * v, 1 + 2 * v - 3 * v**2, v**2]) / 2
    point = np.einsum("nk,nkc->nc", basis, control)
    tangent = np.einsum("nk,nkc->nc", derivative, control)
    aside = np.cross(tangent, rng.normal(size=(n, 3)))
    surface = point + 0.004 * aside / np.linalg.norm(aside, axis=-1, keepdims=True)
    padded = np.concatenate([control, np.full((n, 4, 1), 0.004)], -1).astype(np.float32)
    place, direction = place_in_segment(
        mi.Vector3f(surface.T.astype(np.float32)),
        mi.Float(padded.ravel()),
        4 * dr.arange(mi.UInt32, n),
        mi.Bool(True),
    )
    assert np.array(place) == pytest.approx(v[:, 0], abs=2e-3)
    cosine = (np.array(direction).T * tangent).sum(-1)
    cosine /= np.linalg.norm(np.array(direction).T, axis=-1) * np.linalg.norm(tangent, axis=-1)
    assert cosine.min() > 1 - 1e-5


@pytest.mark.parametrize(
    ("counts", "uv", "message"),
    [
        ([5, 6], None, "add up to at most the 10 segments"),
        ([0, 5], None, "must be positive"),
        ([5, 5], [[0.5, 0.5]], r"root_uv must be \(2, 2\)"),
        ([5, 5], [[0.5, 1.5], [0, 0]], r"root_uv must be \(2, 2\) in \[0, 1\]"),
    ],
)
def test_shapes_that_do_not_fit_are_refused(counts, uv, message):
    with pytest.raises(ValueError, match=message):
        strand_parameters(np.zeros((16, 4)), np.arange(10), counts, root_uv=uv)
