"""The published set read back, and its scorer beside `evaluate` and figures known by hand."""

from __future__ import annotations

import ast
import json
import shutil
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from benchmarks.publishing import published_set
from benchmarks.publishing.published_set import SCORER, difference, score_alone, write_subject

from reconstruction import (
    Light,
    Mesh,
    Strands,
    import_folder,
    read_exr,
    write_obj,
    write_strands,
)
from reconstruction.evaluation.assessment import assess_strands


@pytest.fixture(scope="module")
def scorer():
    space = {"__name__": "score_alone"}
    exec(compile(SCORER.read_text(), str(SCORER), "exec"), space)
    return SimpleNamespace(**space)


def line(*points, offset=(0, 0, 0)):
    return np.array(points, float) + offset


def cloud(scorer, *lines):
    strands = Strands.from_list(list(lines))
    return scorer.Cloud(strands.points, strands.offsets)


def test_the_scorer_needs_numpy_and_scipy_only() -> None:
    tree = ast.parse(SCORER.read_text())
    used = {
        a.name.split(".")[0] for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names
    }
    used |= {
        (n.module or "").split(".")[0] for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)
    }
    assert used - set(sys.stdlib_module_names) == {"numpy", "scipy"}


def test_thresholds_of_distance_and_angle(scorer) -> None:
    """A parallel 1.5 mm away matches from 2 mm on; one turned by 35° from 4 mm/40° on."""
    true = cloud(scorer, line((0, 0, 0), (0, 0, 0.05)))
    beside = scorer.score(cloud(scorer, line((1.5e-3, 0, 0), (1.5e-3, 0, 0.05))), true)["all"]
    assert [round(s["f"], 6) for s in beside.values()] == [0, 1, 1, 1, 1]
    turned = line((0, 0, 0), (4e-4 * np.tan(np.radians(35)), 0, 4e-4))
    found = scorer.score(cloud(scorer, turned), true)["all"]
    assert [s["precision"] for s in found.values()] == [0, 0, 0, 1, 1]
    across = scorer.score(cloud(scorer, line((0, 0, 0), (1e-3, 0, 1e-5))), true)["all"]
    assert across["4mm_40deg"]["precision"] == 0
    assert across["4mm_90deg"]["precision"] == 1


def test_strand_consistency_of_a_strand_in_two_pieces(scorer) -> None:
    """A strand of 100 points found as 60 and 40 of another: 0.6, with recall 1."""
    true = cloud(scorer, line((0, 0, 0), (0, 0, 0.099)))
    halves = [line((0, 0, 0), (0, 0, 0.0590)), line((0, 0, 0.0600), (0, 0, 0.099))]
    found = scorer.score(cloud(scorer, *halves), true)
    assert found["all"]["1mm_10deg"]["recall"] == 1
    assert found["strand_consistency"]["1mm_10deg"] == pytest.approx(0.6, abs=0.011)
    assert found["metres"]["true"] == pytest.approx(0.099)


def test_nothing_far_and_long(scorer) -> None:
    true = cloud(scorer, line((0, 0, 0), (0, 0, 0.05)))
    far = scorer.score(cloud(scorer, line((1, 0, 0), (1, 0, 0.05))), true)
    assert {s["f"] for s in far["all"].values()} == {0}
    assert set(far["strand_consistency"].values()) == {0}
    empty = scorer.Cloud(np.zeros((0, 3), "f4"), np.zeros(1, np.int64))
    assert scorer.score(empty, true)["all"]["3mm_30deg"]["recall"] == 0
    with pytest.raises(SystemExit, match="metres"):
        cloud(scorer, line((0, 0, 0), (0, 0, 4e5)))
    with pytest.raises(SystemExit, match="finite"):
        scorer.Cloud(np.full((2, 3), np.nan, "f4"), np.array([0, 2]))


def test_it_reads_strand_files(scorer, tmp_path) -> None:
    strands = Strands.from_list([line((0, 0, 0), (0, 0, 1)), line((1, 0, 0), (0, 0, 1), (0, 0, 0))])
    for suffix in (".npz", ".hair"):
        write_strands(tmp_path / f"s{suffix}", strands)
    (tmp_path / "s.obj").write_text("v 0 0 0\nv 0 0 1\nv 1 0 0\nl 1 2\nl -1 2 1\n")
    for suffix in (".npz", ".hair", ".obj"):
        points, offsets = scorer.read_strands(tmp_path / f"s{suffix}")
        np.testing.assert_array_equal(points, strands.points)
        assert offsets.tolist() == [0, 2, 5]


def test_a_set_read_back_agrees_with_evaluate(shoot, tmp_path) -> None:
    """The folder imports; its scorer's figures are those of `assess_strands` to rounding."""
    rng = np.random.default_rng(0)
    lights = [Light(f"light_{k}", (k - 1.0, -1, 0.3), (8, 4, 2)) for k in range(3)]
    y, x = np.indices((64, 64)) - 31.5
    share = {"light_0": 0.2, "light_1": 0.5, "light_2": 0.3}
    stage = shoot(
        lights=lights, sweep=False, extra=lambda step, _: share[step["light"]] * (x**2 + y**2 < 700)
    )
    roots = rng.normal(size=(60, 3))
    roots *= 0.1 / np.linalg.norm(roots, axis=1, keepdims=True)
    true = Strands.from_list([np.linspace(r, r - (0, 0, 0.06), 20) for r in roots], 4e-4)
    truth = tmp_path / "truth"
    truth.mkdir()
    write_strands(truth / "strands.npz", true)
    corners = 0.05 * np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
    write_obj(truth / "head.obj", Mesh(corners, [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]))
    (truth / "appearance.json").write_text(json.dumps({}))
    folder = tmp_path / "set" / "subject"
    write_subject(stage, truth, folder)
    shutil.copyfile(SCORER, tmp_path / "set" / "score.py")
    lit = import_folder(folder / "lit", tmp_path / "lit")
    assert [s.kind for s in lit.steps] == ["all_on"]
    capture = import_folder(folder / "stage", tmp_path / "stage")
    assert capture.mask("left").any()
    np.testing.assert_array_equal(
        capture.light("light_1", "left")[0],
        read_exr(folder / "stage" / "images" / "left" / "light_1.exr")[0],
    )
    pred = Strands.from_list([true[i] + rng.normal(0, 4e-4, true[i].shape) for i in range(60)] * 2)
    write_strands(tmp_path / "pred.npz", pred)
    cameras, (true, head) = capture.rig.cameras, published_set.published_truth(folder)
    for samples in (500, None):
        theirs = assess_strands(pred, true, cameras=cameras, head=head, samples=samples).figures
        ours = score_alone(folder, tmp_path / "pred.npz", "--samples", samples or 0)
        assert 0 < ours["visible"]["1mm_10deg"]["f"] < 1
        assert difference(ours, theirs) < 1e-6
    assert ours["all"]["1mm_10deg"] != ours["visible"]["1mm_10deg"]
