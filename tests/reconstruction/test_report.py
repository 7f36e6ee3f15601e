"""Reports: timed, saved, read back, drawn."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from reconstruction import Report, Stage, silent
from reconstruction.report.plots import plot_geometry, plot_report
from reconstruction.report.progress import ReportWithProgress
from reconstruction.report.report import LeftOut, Series


@pytest.fixture
def report() -> Report:
    cg = Series("cg", "residual", [(0.0, 1.0), (0.1, 0.1), (0.2, 1e-3), (0.3, 0.0)])
    slow = Series("explicit_steps", "residual", [(0.01 * i, 1 / (1 + i)) for i in range(60)])
    field = Stage("field", 3.5, {"voxels": 120}, [cg, slow], warnings=["one camera is dark"])
    field.leave_out("motion solve", "the subject did not move", "12 s")
    return Report([Stage("roughness_and_colour", 250.0), field])


def test_a_stage_is_timed_and_replaced_by_name() -> None:
    report = Report()
    with report.stage("a") as stage:
        stage.figures["n"] = 1
        stage.warn("thin ice")
        time.sleep(0.01)
    with report.stage("b"):
        silent("b", 0.5)
    with report.stage("a") as stage:
        stage.figures["n"] = 2
    assert [s.name for s in report.stages] == ["b", "a"]
    assert report["a"].figures == {"n": 2}
    assert report["a"].warnings == []
    with pytest.raises(KeyError, match=r"no stage 'c'.*'b', 'a'"):
        report["c"]


def test_a_stage_that_fails_is_timed_too() -> None:
    report = Report()

    def fail() -> None:
        with report.stage("a"):
            time.sleep(0.02)
            raise RuntimeError("boom")

    with pytest.raises(RuntimeError, match="boom"):
        fail()
    assert 0.02 <= report["a"].seconds < 1


def test_a_stage_that_was_not_expected_or_does_not_come_takes_no_progress_back() -> None:
    shares: list[float] = []
    report = ReportWithProgress(
        lambda _, share: shares.append(share), ["masks", "depth", "field", "roots"]
    )
    for name in ("masks", "lightcodes", "field", "roots"):
        with report.stage(name):
            for share in (0.5, 0.2, 1.0):
                report.progress("doing it", share)
    assert shares == sorted(shares)
    ends = shares[3::4]
    assert all(np.diff([0, *ends]) > 0)
    assert ends[-1] == 1


def test_read_back(report: Report, tmp_path: Path) -> None:
    report.save(tmp_path / "report.json")
    again = Report.load(tmp_path / "report.json")
    assert again == report
    assert isinstance(again["field"].left_out[0], LeftOut)
    assert [p.name for p in tmp_path.iterdir()] == ["report.json"]
    assert Report.load(tmp_path / "none.json") == Report()


def test_numbers_that_are_none_are_refused(report: Report, tmp_path: Path) -> None:
    report["field"].figures["bad"] = float("nan")
    with pytest.raises(ValueError, match="JSON compliant"):
        report.save(tmp_path / "report.json")
    assert not list(tmp_path.iterdir())


def picture(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None, path
    return image


def test_plots(report: Report, tmp_path: Path) -> None:
    files = plot_report(report, tmp_path / "plots")
    assert [f.name for f in files] == ["seconds.png", "error_field.png"]
    for file in files:
        image = picture(file)
        assert image.shape[1] > 900
        assert 0.003 < (image.min(axis=2) < 128).mean() < 0.5


def test_geometry_bars(tmp_path: Path) -> None:
    names = ("1mm_10deg", "2mm_20deg", "3mm_30deg")

    def scores(value: float) -> dict[str, dict[str, float]]:
        return {n: dict.fromkeys(("precision", "recall", "f"), value) for n in names}

    both = {"visible": scores(0.5), "all": scores(0.4)}
    tall = picture(plot_geometry({"ours": both, "hull_vertical": both}, tmp_path / "a.png"))
    flat = picture(plot_geometry({"ours": {"all": scores(0.0)}}, tmp_path / "b.png"))
    assert tall.shape[0] > 1.4 * flat.shape[0]
    with pytest.raises(ValueError, match="no results"):
        plot_geometry({}, tmp_path / "c.png")


def test_a_stage_knows_its_peak_memory_and_gives_it_to_the_stage_around_it() -> None:
    report = Report()
    with report.stage("outer"):
        with report.stage("inner"):
            block = np.ones(40_000_000)  # 320 MB
            assert block.sum() == len(block)
            del block
        with report.stage("small"):
            pass
    inner, outer, small = (report[n].peak_gb for n in ("inner", "outer", "small"))
    if inner is None or outer is None or small is None:
        pytest.skip("this system does not tell a process its peak memory")
    assert inner > small + 0.2
    assert outer >= inner


def test_a_stage_within_another_is_not_counted_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seven seconds of triangulation and three of motion are ten of the clock's."""
    clock = iter([0.0, 1.0, 4.0, 10.0])
    monkeypatch.setattr("reconstruction.report.report.time.perf_counter", lambda: next(clock))
    report = Report([Stage("motion", 99.0), Stage("masks", 5.0)])
    with report.stage("triangulation"), report.stage("motion"):
        pass
    assert {s.name: s.seconds for s in report.stages} == {
        "masks": 5.0,
        "triangulation": 7.0,
        "motion": 3.0,
    }


@pytest.mark.parametrize(("text", "said"), [('{"stages": 3}', "stages: "), ("{", "Invalid JSON")])
def test_a_damaged_report_is_named(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "report.json").write_text(text)
    with pytest.raises(ValueError, match=rf"report\.json: not a report: .*{said}"):
        Report.load(tmp_path / "report.json")
