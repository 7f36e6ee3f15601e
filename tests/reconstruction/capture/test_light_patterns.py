"""Patterns of lights: their tables, imports, and single lights by demultiplexing."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import hadamard

from reconstruction import (
    Capture,
    CaptureError,
    CaptureWriter,
    Model,
    Step,
    silent,
    verify,
    write_exr,
)
from reconstruction.capture.demultiplexing import demultiplex
from reconstruction.capture.import_folder import import_folder
from reconstruction.capture.light_patterns import (
    Demultiplexing,
    LightPatterns,
    PatternError,
    read_patterns,
)
from stage_service.cli import main
from stage_service.jobs.records import JobOptions
from stage_service.jobs.steps import StepContext

LIGHTS = [f"light_{i:02d}" for i in range(7)]
S = (1 - hadamard(8)[1:, 1:]) // 2
"""The S-matrix of order 7."""
SINGLES = np.random.default_rng(0).random((2, 7, 16, 24, 3)).astype(np.float32)
CAMERAS = ("left", "right")


def test_gains_of_an_s_matrix_are_the_published_ones() -> None:
    """Harwit and Sloane (1979): 2√n / (n + 1), and √((n + 1) / 2) times that of photons."""
    solution = Demultiplexing(S.astype(float))
    np.testing.assert_allclose(solution.read_gain, 2 * np.sqrt(7) / 8)
    np.testing.assert_allclose(solution.photon_gain, 2 * np.sqrt(7) / 8 * 2)
    assert solution.condition == pytest.approx(np.sqrt(8))
    (warning,) = solution.warnings()
    assert "photon noise of 7 of 7 lights is amplified, up to 1.3 times" in warning
    assert not Demultiplexing(np.eye(5)).warnings()
    assert not Demultiplexing(S[:5].astype(float)).spans
    near = np.ones((2, 2)) - np.diag([0.0, 1e-4])
    assert "condition number 4e+04" in Demultiplexing(near).warnings()[0]


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("name,0,1\np,1,nan", "pattern p: the weight of light_01 must be 0 to 1, got nan"),
        ("name,0,1\np,-1,0", "weight of light_00 must be 0 to 1"),
        ("name,0,1\np,0,0\nq,1,0", "pattern p lights nothing"),
        ("name,0,1\np,0,0", "at least one"),
        ("name,0,9\np,1,1", "there is no light '9'; its 7 are light_00"),
        ("name,0,1\np,1", "pattern p: expected one row of 2 weights, got 1"),
        ("name,0,00\np,1,1", "two columns are of the same light"),
        ("name,0,1\np,1,on", "pattern p: could not convert"),
        ("name,0,1\n../p,1,1", "a file's name that no light has"),
        ("", "expected a header with the lights"),
        ({"p": {"light_00": 2}}, "must be 0 to 1, got 2"),
        ({"p": 3}, "pattern p: expected weights by light, or a list of lights"),
        ([], "expected an object of patterns"),
    ],
)
def test_a_wrong_table_is_refused(table: str | dict | list, said: str, tmp_path: Path) -> None:
    path = tmp_path / ("patterns.csv" if isinstance(table, str) else "patterns.json")
    path.write_text(table if isinstance(table, str) else json.dumps(table))
    with pytest.raises(PatternError, match=said) as error:
        read_patterns(path, LIGHTS)
    assert str(path) in str(error.value)


def test_tables_of_both_kinds_are_read_alike(tmp_path: Path) -> None:
    table, objects = tmp_path / "a.csv", tmp_path / "b.json"
    table.write_text("name, light_03 ,1,2\nsky,1,0.5,0\nall,1,1,0\n")
    rows = {"sky": {"light_03": 1, "1": 0.5}, "all": ["light_03", "light_01"]}
    objects.write_text(json.dumps({"patterns": rows}))
    for found in (read_patterns(table, LIGHTS), read_patterns(objects, LIGHTS)):
        assert found.names == ("sky", "all")
        assert found.lights == ("light_03", "light_01")  # light_02 is in no pattern
        np.testing.assert_array_equal(found.weights, [[1, 0.5], [1, 1]])


def folder_of(root: Path, weights: np.ndarray, layout: str = "images/{camera}/{pattern}.exr"):
    root.mkdir()
    pose = {"K": [[40, 0, 11.5], [0, 40, 7.5], [0, 0, 1]], "R": [[1, 0, 0], [0, 0, -1], [0, 1, 0]]}
    cameras = [
        {"id": c, "width": 24, "height": 16, **pose, "t": [0.1 * i, 0, 1.0]}
        for i, c in enumerate(CAMERAS)
    ]
    places = [[np.cos(i), np.sin(i) - 0.2, 0.4] for i in range(7)]
    lights = [{"id": i, "position": p, "intensity": [1, 1, 1]} for i, p in enumerate(places)]
    (root / "cameras.json").write_text(json.dumps({"cameras": cameras}))
    (root / "lights.json").write_text(json.dumps({"lights": lights}))
    rows = [f"p_{k}," + ",".join(map(str, row)) for k, row in enumerate(weights.tolist())]
    (root / "patterns.csv").write_text("\n".join(["name,0,1,2,3,4,5,6", *rows]))
    for k, row in enumerate(weights):
        for c, singles in zip(CAMERAS, SINGLES, strict=True):
            path = root / layout.format(camera=c, pattern=f"p_{k}")
            path.parent.mkdir(parents=True, exist_ok=True)
            write_exr(path, np.tensordot(row.astype(np.float32), singles, 1))
    return root


@pytest.mark.parametrize("layout", ["{camera}/{pattern}", "{pattern}/{camera}"])
def test_patterns_become_single_lights(
    layout: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """From the command line; the frames are sums of known single lights."""
    folder, out, single = (
        folder_of(tmp_path / "f", S, f"images/{layout}.exr"),
        *(tmp_path / n for n in "cs"),
    )
    assert main(["import", str(folder), "--out", str(out)]) == 0
    assert Capture(out).lightings() == [f"p_{k}" for k in range(7)]
    assert main(["demultiplex", str(out), "--out", str(single)]) == 0
    said = capsys.readouterr()
    assert "read noise: 0.66 times a single frame's, at most 0.66" in said.out
    assert "warning: photon noise of 7 of 7 lights is amplified" in said.err
    found = Capture(single)
    assert verify(single) == []
    for camera, singles in zip(CAMERAS, SINGLES, strict=True):
        np.testing.assert_allclose(found.olat(camera, LIGHTS)[0], singles, atol=2e-6)
    assert main(["demultiplex", str(single), "--out", str(tmp_path / "t")]) == 3
    assert "no frames under patterns" in capsys.readouterr().err


def test_too_few_patterns_are_refused_and_a_table_elsewhere_is_named(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "f", S[:5])
    table = (folder / "patterns.csv").rename(tmp_path / "table.csv")
    words = ["import", str(folder), "--pictures", "images/{camera}/{pattern}.*"]
    assert main([*words, "--out", str(tmp_path / "c"), "--patterns", str(table)]) == 0
    with pytest.raises(CaptureError, match="5 patterns do not determine 7 lights: 'hairstage rec"):
        demultiplex(Capture(tmp_path / "c"), tmp_path / "s")
    assert not (tmp_path / "s").exists()


def test_a_job_takes_the_single_lights_that_patterns_determine(tmp_path: Path) -> None:
    whole, few = (
        import_folder(folder_of(tmp_path / f"f{len(rows)}", rows), tmp_path / f"c{len(rows)}").path
        for rows in (S, S[:5])
    )
    model = Model(tmp_path / "model")

    def frames(capture: Path) -> Capture:
        return StepContext(capture, model, JobOptions(), silent).frames()

    first = frames(whole)
    for camera, singles in zip(CAMERAS, SINGLES, strict=True):
        np.testing.assert_allclose(first.olat(camera, LIGHTS)[0], singles, atol=2e-6)
    written = (first.path / "manifest.json").stat().st_mtime_ns
    assert (frames(whole).path / "manifest.json").stat().st_mtime_ns == written
    assert frames(few).lightings() == [f"p_{k}" for k in range(5)]
    other = frames(import_folder(folder_of(tmp_path / "f", np.eye(7)), tmp_path / "c").path)
    assert (other.path / "manifest.json").stat().st_mtime_ns > written
    shutil.rmtree(tmp_path / "c")  # imported again, with another table of the same folder
    rows = (tmp_path / "f" / "patterns.csv").read_text().splitlines()
    turned = [rows[0], *(f"p_{k},{row.split(',', 1)[1]}" for k, row in enumerate(rows[:0:-1]))]
    (tmp_path / "f" / "patterns.csv").write_text("\n".join(turned))
    again = frames(import_folder(tmp_path / "f", tmp_path / "c").path)
    np.testing.assert_allclose(again.olat("left", LIGHTS)[0], SINGLES[0][::-1], atol=2e-6)


def test_a_reconstruction_that_was_killed_while_demultiplexing_begins_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    capture, model = (
        import_folder(folder_of(tmp_path / "f", S), tmp_path / "c").path,
        tmp_path / "m",
    )
    (model / "work" / "single_lights").mkdir(parents=True)
    (model / "work" / "single_lights" / "rig.json").write_text("{}")
    begun = []
    monkeypatch.setattr("stage_service.jobs.steps.demultiplex", lambda *given: begun.append(given))
    main(["reconstruct", str(capture), "--out", str(model)])
    assert "no model's" not in capsys.readouterr().err
    assert [out for _, out, _ in begun] == [model / "work" / "single_lights"]
    assert not (model / "work" / "single_lights").exists()


def test_noisy_and_missing_frames(tmp_path: Path) -> None:
    """Twice the patterns: a noisy frame weighs less, a missing one is done without."""
    weights = np.concatenate([S, np.eye(7)])
    folder = folder_of(tmp_path / "f", weights)
    noise = np.random.default_rng(1).normal(0, 0.5, (16, 24, 3))
    bad = np.tensordot(S[2], SINGLES[0], 1) + noise
    write_exr(folder / "images" / "left" / "p_2.exr", bad)
    (folder / "images" / "right" / "p_3.exr").unlink()
    made = demultiplex(import_folder(folder, tmp_path / "c"), tmp_path / "s")
    assert made.misfit is not None
    assert made.misfit > 0.01
    left, right = (made.capture.olat(c)[0] for c in CAMERAS)
    np.testing.assert_allclose(right, SINGLES[1], atol=5e-6)
    unweighted = np.linalg.norm(np.linalg.pinv(weights)[:, 2]) * 0.5 / np.sqrt(7)
    assert np.std(left - SINGLES[0]) < 0.1 * unweighted


def test_a_saturated_pixel_is_in_the_lights_that_it_takes_part_in(tmp_path: Path) -> None:
    rig = import_folder(folder_of(tmp_path / "f", S), tmp_path / "c").rig
    weights = np.eye(7)
    weights[0, 1] = 1  # light 0 is the difference of frames 0 and 1
    patterns = LightPatterns(tuple("abcdefg"), tuple(LIGHTS), weights)
    steps = [Step(k, "pattern", 0.1, pattern=n) for k, n in enumerate(patterns.names)]
    steps.append(Step(7, "dark", 0.1))
    plan = {"steps": steps, "patterns": patterns.to_dict()}
    writer = CaptureWriter.create(tmp_path / "d", rig, plan)
    for camera in CAMERAS:
        for step in steps:
            image = np.full((16, 24, 3), 0.5 if step.kind == "dark" else 1.5, np.float32)
            image[3, 5] = 4.0 if step.index == 1 else image[3, 5]
            writer.write_frame(step, camera, image, full_scale=4.0)
    writer.finish("completed")
    demultiplex(Capture(tmp_path / "d"), tmp_path / "s")
    image, valid = Capture(tmp_path / "s").olat("left")
    assert [tuple(x) for x in np.argwhere(~valid)] == [(0, 3, 5), (1, 3, 5)]
    np.testing.assert_allclose(image[1:, 0, 0], 1.0, rtol=1e-6)  # the dark frame's light is off
    np.testing.assert_allclose(image[0, 0, 0], 0.0, atol=1e-6)
