"""The procedural head and grooms, and strand files as subjects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from reconstruction import Rig, Strands, write_strands
from reconstruction.head.generic import generic_head, skin_distance
from simulators.subject.clothing import PARTS
from simulators.subject.subject import SubjectError, check_fits, load_subject, make_subject

DEMO = Path(__file__).parents[3] / "stage_service" / "rigs" / "demo.toml"
NAMES = ("wavy", "straight", "curly")


@pytest.fixture(scope="module")
def subjects():
    return {name: make_subject(name, 3, strands=1500) for name in NAMES}


def test_the_head_is_closed_and_human_in_size():
    head = generic_head()
    edges = np.sort(head.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 2).all()
    volume = np.einsum(
        "ij,ij->",
        head.vertices[head.faces[:, 0]],
        np.cross(*head.vertices[head.faces[:, 1:]].swapaxes(0, 1)),
    )
    assert 0.003 < volume / 6 < 0.007  # outward normals, litres of a head with its neck
    low, high = head.vertices.min(axis=0), head.vertices.max(axis=0)
    assert high[0] - low[0] == pytest.approx(0.17, abs=0.02)  # over the ears
    assert high[1] - low[1] == pytest.approx(0.22, abs=0.02)  # with the nose
    assert high[2] == pytest.approx(0.115, abs=0.003)
    assert head.vertices[head.vertices[:, 1].argmin(), 2] == pytest.approx(-0.02, abs=0.02)


def test_the_scalp_is_the_top_and_the_back():
    head = generic_head()
    middle = head.vertices[head.faces].mean(axis=1)
    assert head.face_areas()[head.scalp].sum() == pytest.approx(0.055, abs=0.01)
    assert not head.scalp[(middle[:, 1] < -0.07) & (middle[:, 2] < 0.05)].any()  # the face
    assert not head.scalp[np.abs(middle[:, 0]) > 0.08].any()  # the ears
    assert head.scalp[middle[:, 2] > 0.1].all()


@pytest.mark.parametrize("name", NAMES)
def test_roots_lie_on_the_scalp(subjects, name):
    head = generic_head()
    faces = head.vertices[head.faces[head.scalp]]
    i, j = np.divmod(np.arange(81), 9)
    w = np.stack([i, j, 8 - i - j], axis=1)[i + j <= 8] / 8
    on_scalp = np.einsum("kc,fcd->fkd", w, faces).reshape(-1, 3)
    distance, _ = cKDTree(on_scalp).query(subjects[name].strands.roots)
    assert distance.max() < 0.6e-3  # the grid's own gaps
    assert np.abs(skin_distance(subjects[name].strands.roots)).max() < 1e-3


@pytest.mark.parametrize("name", NAMES)
def test_hair_stays_out_of_the_head(subjects, name):
    points = subjects[name].strands.points.astype(float)
    assert skin_distance(points).min() > -1e-3


@pytest.mark.parametrize("name", NAMES)
def test_lengths_are_human_and_points_evenly_spaced(subjects, name):
    strands = subjects[name].strands
    low, median, high = np.percentile(strands.lengths(), [2, 50, 98])
    assert low > 0.06
    assert 0.11 < median < 0.20
    assert high < 0.26
    starts = strands.segment_starts
    step = np.linalg.norm(strands.points[starts + 1] - strands.points[starts], axis=1)
    assert np.percentile(step, 99.9) < 0.015


def test_styles_differ_in_how_much_they_turn(subjects):
    """Median turn per centimetre away from the root, degrees."""
    turn = {}
    for name in NAMES:
        strands = subjects[name].strands.resampled(0.005)
        d = strands.tangents()
        starts = strands.segment_starts
        cosine = (d[starts] * d[starts + 1]).sum(axis=1).clip(-1, 1)
        turn[name] = 2 * np.degrees(np.median(np.arccos(cosine)))
    assert turn["straight"] < 0.6 * turn["wavy"] < 0.5 * turn["curly"]


def test_tight_coils_have_the_radius_and_pitch_of_type_4c():
    strands = make_subject("coils", 3, strands=1500).strands
    assert skin_distance(strands.points.astype(float)).min() > -1e-3
    radii, pitches = [], []
    for i in range(0, len(strands), 10):
        half = strands[i][len(strands[i]) // 2 :].astype(float)
        curvature, torsion = curvature_and_torsion(half)
        squared = curvature**2 + torsion**2  # of a helix of radius r and pitch 2πc
        radii.append(np.median(curvature / squared))
        pitches.append(2 * np.pi * np.median(np.abs(torsion) / squared))
    assert 2e-3 < np.median(radii) < 4e-3
    assert 3e-3 < np.median(pitches) < 6e-3


def curvature_and_torsion(line):
    d1 = np.gradient(line, axis=0)
    d2 = np.gradient(d1, axis=0)
    d3 = np.gradient(d2, axis=0)
    cross = np.cross(d1, d2)
    area = np.linalg.norm(cross, axis=1)
    speed = np.linalg.norm(d1, axis=1)
    kept = slice(4, -4)
    return (area / speed**3)[kept], ((cross * d3).sum(axis=1) / area**2)[kept]


def test_a_dressed_subject_has_a_beard_and_parts_off_its_skin():
    dressed, bare = make_subject("dressed", 3, strands=300), make_subject("wavy", 3, strands=300)
    own = len(bare.strands.points)
    assert dressed.strands.points[:own].tobytes() == bare.strands.points.tobytes()
    beard = dressed.strands.points[own:].astype(float)
    assert len(dressed.strands) == len(bare.strands) + dressed.beard
    assert skin_distance(beard).min() > -1e-3
    roots = dressed.strands.roots[-dressed.beard :]
    assert roots[:, 2].max() < -0.03  # below the nose
    assert roots[:, 1].max() < 0.0  # in front of the ears
    worn = dressed.dressed
    corners = worn.mesh.vertices[worn.mesh.faces]
    lowest = [skin_distance(corners[worn.part == k][::31, 0]).min() for k in range(1, len(PARTS))]
    assert min(lowest) > 2e-3
    shoulder = (worn.part == 1) & (np.abs(corners[..., 2].mean(axis=1) + 0.2) < 2e-3)
    x, y = corners[shoulder].mean(axis=1)[:, :2].T
    order = np.argsort(np.arctan2((y - 0.034) / 0.11, x / 0.2))
    changes = np.count_nonzero(np.diff(worn.materials.albedo[shoulder][order, 0]))
    assert 1.0e-3 < 1.0 / changes < 2.5e-3  # metres of a circumference of a metre


@pytest.mark.parametrize(
    "name", [NAMES[0], *(pytest.param(n, marks=pytest.mark.slow) for n in NAMES[1:])]
)
def test_the_full_groom_has_a_head_of_hair(name):
    subject = make_subject(name, 0)
    assert 8_000 <= len(subject.strands) <= 12_000
    assert subject.strands.radius * len(subject.strands) == pytest.approx(100_000 * 40e-6)


def test_the_seed_decides_every_byte(subjects):
    again, other = (make_subject("wavy", seed, strands=1500) for seed in (3, 4))
    assert again.strands.points.tobytes() == subjects["wavy"].strands.points.tobytes()
    assert not np.isin(other.strands.roots[:, 0], again.strands.roots[:, 0]).any()


@pytest.mark.parametrize("name", ["wavy", "curly"])
def test_a_mixed_subject_has_the_strands_of_its_groom_in_several_colours(subjects, name):
    mixed = make_subject(f"{name}-mixed", 3, strands=1500)
    assert mixed.strands.points.tobytes() == subjects[name].strands.points.tobytes()
    layers, count, _ = mixed.absorption.shape
    assert (layers, count) == (32, 1500)
    np.testing.assert_allclose(mixed.hair.sigma_a, mixed.absorption.mean(axis=(0, 1)))
    white = mixed.absorption[..., 1].max(axis=0) < 0.01
    assert 0.08 < white.mean() < 0.35
    side = np.abs(mixed.strands.roots[:, 0])
    assert white[side > 0.07].mean() > 2 * white[side < 0.03].mean()  # at the temples first
    root, tip = mixed.absorption[0, ~white], mixed.absorption[-1, ~white]
    assert np.median(tip / root) == pytest.approx(0.35 / 1.5, rel=0.02)
    # beside each other: a strand's colour does not predict its neighbour's
    green, roots = np.log(root[:, 1]), mixed.strands.roots[~white]
    near = cKDTree(roots).query(roots, k=2)[1][:, 1]
    assert abs(np.corrcoef(green, green[near])[0, 1]) < 0.2


def test_a_strand_file_is_a_subject_and_a_thinned_one_gets_thicker(tmp_path, subjects):
    lines = []
    file = tmp_path / "groom.npz"
    write_strands(file, Strands(subjects["wavy"].strands.points, subjects["wavy"].strands.offsets))
    subject = load_subject(str(file), say=lines.append)
    assert len(subject.strands) == 1500
    assert subject.strands.radius == 1e-3
    assert "1500 strands" in lines[0]
    assert subject.head is None
    assert subject.hair.sigma_a == (0.10, 0.20, 0.45)


def test_sintel_fits_the_demo_rig(shared_data):
    head = shared_data("sintel/sintel_head.obj")
    lines = []
    subject = load_subject(str(shared_data("sintel/sintel.npz")), head, say=lines.append)
    assert len(subject.strands) == 11_400
    assert subject.strands.radius == pytest.approx(0.351e-3, abs=1e-6)
    assert "0.35 mm" in lines[0]
    check_fits(subject, Rig.load(DEMO))


def test_a_subject_outside_the_rig_raises_an_error(tiny_rig, subjects):
    subject = subjects["wavy"]
    check_fits(subject, tiny_rig)
    moved = subject.strands.transformed(np.eye(3), [0, 0, 1.6])
    elsewhere = type(subject)("hair", moved, None, subject.hair, subject.skin)
    with pytest.raises(SubjectError, match=r"only 0%.*cam_a of rig tiny.*convert"):
        check_fits(elsewhere, tiny_rig)


@pytest.mark.parametrize(
    ("name", "head", "said"),
    [("afro", None, "wavy, straight, curly"), ("wavy", "x.obj", "own head")],
)
def test_unknown_subjects_are_errors(name, head, said):
    with pytest.raises(SubjectError, match=said):
        load_subject(name, head)
