"""Strands against heads whose inside is known: spheres, and the generic head by solid angles."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.measure import marching_cubes

from reconstruction import Mesh, Strands
from reconstruction.geometry import collisions
from reconstruction.geometry.collisions import SKIN, Collisions
from reconstruction.geometry.mesh_distance import MeshDistance
from reconstruction.head.generic import generic_head

R = 0.075
PUSHED = ("through", "beside", "shallow", "dives", "within", "coarse")


def line(a: tuple[float, ...], b: tuple[float, ...], count: int = 60) -> np.ndarray:
    return np.linspace(a, b, count)


LINES = {
    "through": line((0, 0, R), (0, 0, -R - 0.05)),
    "beside": line((0.03, 0, -0.1), (0.03, 0, 0.12)),
    "shallow": line((-0.05, 0, R - 0.004), (0.06, 0, R + 0.001), 40),
    "dives": line((0, 0, 0.12), (0.03, 0, 0.05)),
    "within": line((0, 0, 0.02), (0.03, 0, -0.03)),
    "coarse": line((-0.1, 0, 0.02), (0.1, 0, 0.02), 2),
    "tangent": line((-0.05, 0, R + 1e-5), (0.06, 0, R + 1e-5)),
    "leaves": line((0, 0, R), (0, 0, R + 0.1)),
    "a point": line((0, 0, 0.01), (0, 0, 0.01), 3),
}


@pytest.fixture(scope="module")
def ball() -> Mesh:
    """A sphere of radius R to 0.03 mm."""
    at = np.linspace(-1.1 * R, 1.1 * R, 40)
    field = np.linalg.norm(np.stack(np.meshgrid(at, at, at, indexing="ij")), axis=0) - R
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(at[1] - at[0],) * 3)
    vertices = vertices + at[0]
    return Mesh(vertices * R / np.linalg.norm(vertices, axis=1, keepdims=True), faces)


@pytest.fixture
def sphere(ball: Mesh, monkeypatch: pytest.MonkeyPatch) -> Mesh:
    """The ball, with the exact distance to a sphere."""

    def distance(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        far = np.linalg.norm(points, axis=1)
        return far - R, points / np.maximum(far, 1e-9)[:, None]

    monkeypatch.setattr(collisions, "MeshDistance", lambda head: distance)
    return ball


def winding(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Solid angle of the mesh over 4π (van Oosterom and Strackee 1983): 1 inside, 0 outside."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=2) for x in (a, b, c))
    top = np.einsum("nfd,nfd->nf", a, np.cross(b, c))
    dots = [np.einsum("nfd,nfd->nf", x, y) for x, y in ((a, b), (b, c), (c, a))]
    below = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
    return np.arctan2(top, below).sum(axis=1) / (2 * np.pi)


def test_distances_to_a_sphere_are_those_of_its_centre(ball: Mesh) -> None:
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (600, 3))
    true = np.linalg.norm(points, axis=1) - R
    distance, out = MeshDistance(ball)(points)
    near = true < 0.001
    np.testing.assert_allclose(distance[near], true[near], atol=1.5e-4)
    np.testing.assert_allclose(distance, true, atol=2e-3)
    close = np.abs(true) < 1e-3
    assert ((out * points).sum(axis=1) > 0.95 * np.linalg.norm(points, axis=1))[close].all()


@pytest.mark.parametrize("how", ["as it is", "inside out in mm", "with a copy of each corner"])
def test_the_inside_is_where_solid_angles_say(how: str) -> None:
    head, unit = generic_head(), 1e3 if how == "inside out in mm" else 1.0
    points = np.random.default_rng(1).uniform((-0.1, -0.12, -0.15), (0.1, 0.12, 0.14), (60, 3))
    inside = winding(head, points) > 0.5
    assert 10 < inside.sum() < 50
    vertices, faces = unit * head.vertices, head.faces
    if how == "inside out in mm":
        faces = faces[:, ::-1]
    elif how == "with a copy of each corner":
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
    distance = MeshDistance(Mesh(vertices, faces))
    assert distance.open_edges == 0
    np.testing.assert_array_equal(distance(unit * points)[0] < 0, inside)


def test_below_a_scalp_alone_is_inside_and_beyond_its_rim_is_not(ball: Mesh) -> None:
    cap = Mesh(ball.vertices, ball.faces[ball.vertices[ball.faces][..., 2].min(axis=1) > 0.01])
    distance = MeshDistance(cap)
    assert distance.open_edges > 50
    heights = distance(np.array([[0, 0, R - 0.01], [0, 0, R + 0.01], [0, 0, -R], [0.09, 0, -0.1]]))
    assert list(np.sign(heights[0])) == [-1, 1, 1, 1]
    hangs = Strands.from_list([line((0, -R - 0.003, 0.02), (0, -0.05, -0.1))])
    assert Collisions(hangs, cap).inside.strands == 0
    assert Collisions(hangs, ball).inside.strands == 1


def test_meshes_without_an_inside_are_refused(ball: Mesh) -> None:
    faces = ball.faces.copy()
    faces[::2] = faces[::2, ::-1]
    with pytest.raises(ValueError, match="recalculate its normals"):
        MeshDistance(Mesh(ball.vertices, faces))
    with pytest.raises(ValueError, match="no area"):
        MeshDistance(Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]])))


def test_what_is_inside_a_sphere_is_the_chord(sphere: Mesh) -> None:
    def inside(name: str):
        return Collisions(Strands.from_list([LINES[name]]), sphere).inside

    through, beside = inside("through"), inside("beside")
    assert through.metres == pytest.approx(2 * R, rel=1e-5)
    assert (through.deepest, through.mean) == pytest.approx((R, R / 2), rel=2e-2)
    half = np.sqrt(R**2 - 0.03**2)
    assert beside.metres == pytest.approx(2 * half, rel=1e-5)
    assert beside.deepest == pytest.approx(R - 0.03, rel=1e-4)
    assert inside("coarse").metres == pytest.approx(2 * np.sqrt(R**2 - 0.02**2), rel=1e-5)
    assert inside("within").metres == pytest.approx(np.hypot(0.03, 0.05), rel=1e-3)
    assert [inside(name).strands for name in ("tangent", "leaves", "a point")] == [0, 0, 1]
    both = Collisions(Strands.from_list(list(LINES.values())), sphere)
    assert list(both.index) == [k for k, n in enumerate(LINES) if n in (*PUSHED, "a point")]


def test_pushed_strands_are_outside_as_long_as_before_and_smooth(sphere: Mesh) -> None:
    given = Strands.from_list([LINES[name] for name in LINES])
    pushed, of = Collisions(given, sphere).resolved("push")
    assert list(of) == list(range(len(given)))
    assert np.linalg.norm(pushed.points, axis=1).min() > R - SKIN
    assert Collisions(pushed, sphere).inside.strands == 0
    np.testing.assert_allclose(pushed.lengths(), given.lengths(), rtol=0.01, atol=1e-6)
    for k, name in enumerate(LINES):
        a, b = given[k], pushed[k]
        root = a[0] if np.linalg.norm(a[0]) > R - SKIN else a[0] * R / np.linalg.norm(a[0])
        np.testing.assert_allclose(b[0], root, atol=2e-4)
        if name not in (*PUSHED, "a point"):
            np.testing.assert_array_equal(b, a)
        if name in PUSHED:
            step = np.diff(b.astype(float), axis=0)
            step /= np.linalg.norm(step, axis=1, keepdims=True)
            turns = np.degrees(np.arccos(np.clip((step[1:] * step[:-1]).sum(axis=1), -1, 1)))
            assert turns.max() < 25, name  # a millimetre each: a radius of over 2 mm
    # the shortest way round: a great circle, of which the strand has 153°
    around = pushed[list(LINES).index("through")]
    np.testing.assert_allclose(around[-1][2], R * np.cos(0.2 / R), atol=2e-3)
    # hair behind a shallow part stays on its line
    tail = pushed[list(LINES).index("shallow")][-5:]
    line_z = (0.005 / 0.11) * (tail[:, 0] + 0.05) + R - 0.004
    np.testing.assert_allclose(tail[:, 2], line_z, atol=1e-5)


def test_curls_and_values_outside_the_head_stay_as_they_are(ball: Mesh) -> None:
    t = np.linspace(0, 0.08, 300)[:, None]
    turn = np.array([np.cos(1e3 * t), np.sin(1e3 * t), 0 * t])[..., 0].T
    curl = np.array([0.0, 0, R + 0.08]) - t * [0.0, 0, 1] + 2e-3 * turn
    dives = np.concatenate([curl, line(tuple(curl[-1]), (0.02, 0, R - 0.01), 20)[1:]])
    n = len(dives)
    radius = np.linspace(1e-4, 2e-5, n).astype(np.float32)
    given = Strands(dives, np.array([0, n]), radius, np.linspace(1, 0, n).astype(np.float32))
    pushed, _ = Collisions(given, ball).resolved("push")
    far = pushed.points[:, 2] > R + 0.02
    assert far.sum() > 200
    first = dives[dives[:, 2] > R + 0.03].astype(np.float32)
    gap = np.linalg.norm(pushed.points[far][:, None] - first[None], axis=2).min(axis=0)
    np.testing.assert_allclose(gap, 0, atol=1e-7)
    assert pushed.radius[[0, -1]] == pytest.approx([1e-4, 2e-5])
    assert pushed.confidence[[0, -1]] == pytest.approx([1, 0])


def test_cut_strands_are_the_parts_outside(sphere: Mesh) -> None:
    given = Strands.from_list([LINES[name] for name in LINES])
    cut, of = Collisions(given, sphere).resolved("cut")
    names = list(LINES)
    assert [names[k] for k in of] == [
        *("through", "beside", "beside", "shallow", "shallow", "dives", "coarse", "coarse"),
        *("tangent", "leaves"),
    ]
    lengths = dict(
        zip(zip([names[k] for k in of], range(99), strict=False), cut.lengths(), strict=True)
    )
    half = np.sqrt(R**2 - 0.03**2)
    assert lengths["through", 0] == pytest.approx(0.05, abs=2e-4)
    assert lengths["beside", 1] == pytest.approx(0.1 - half, abs=2e-4)
    assert lengths["beside", 2] == pytest.approx(0.12 - half, abs=2e-4)
    np.testing.assert_allclose(np.linalg.norm(cut.roots[[0, 2]], axis=1), R, atol=1e-4)
    assert Collisions(cut, sphere).inside.strands == 0


def test_no_strands_and_strands_all_inside(sphere: Mesh) -> None:
    none = Strands.from_list([])
    for strands, how in (
        (none, "push"),
        (none, "cut"),
        (Strands.from_list([LINES["within"]]), "cut"),
    ):
        left, of = Collisions(strands, sphere).resolved(how)
        assert len(left) == len(of) == 0
    assert Collisions(none, sphere).inside.metres == 0
