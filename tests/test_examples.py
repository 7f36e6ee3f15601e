"""The examples run, on a tiny capture; their figures are what is known of its subject."""

from __future__ import annotations

import os
import re
import runpy
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where the examples run, so that they share one tiny capture."""
    return tmp_path_factory.mktemp("examples")


def run(name: str, folder: Path, capsys, *arguments: str) -> str:
    """What an example prints; it runs in this process and finds its neighbours."""
    here = Path.cwd()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [name, *arguments])
        patch.syspath_prepend(EXAMPLES)
        os.chdir(folder)
        try:
            runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        finally:
            os.chdir(here)
    return str(capsys.readouterr().out)


def test_a_pixel_is_brightest_under_one_of_331_lights(folder, capsys) -> None:
    said = run("reflectance.py", folder, capsys)
    assert "331 lights, 4 cameras of 32 pixels" in said
    assert re.search(r"under light_\d{3}", said)
    assert (folder / "runs" / "reflectance.png").stat().st_size > 5000


def test_orientations_and_strands_of_a_capture(folder, capsys) -> None:
    said = run("orientation_and_strands.py", folder, capsys)
    found = re.search(r"(\d+) strands, ([\d.]+) m", said)
    assert found
    assert int(found[1]) > 300
    assert (folder / "runs" / "example_model" / "strands.npz").is_file()


def test_a_smoother_fibre_has_brighter_highlights(folder, capsys) -> None:
    said = run("roughness.py", folder, capsys)
    smooth, rough = (float(x) for x in re.findall(r"percentile ([\d.]+)", said))
    assert smooth > 1.1 * rough


def test_half_of_the_strands_are_all_right_and_half_of_the_truth(folder, capsys) -> None:
    said = run("score_strands.py", folder, capsys)
    assert "jitter of 0.5 mm: 300 strands" in said
    half = said.partition("every second strand")[2]
    precision, recall = re.findall(r"1mm_10deg: precision ([\d.]+) %, recall ([\d.]+) %", half)[0]
    assert float(precision) == 100.0
    assert 45 < float(recall) < 65


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda p: p.name)
def test_examples_are_notebooks(path: Path) -> None:
    """jupytext reads each but the module that they share as cells of text and code."""
    if path.name == "tiny_capture.py":
        return
    jupytext = pytest.importorskip("jupytext")
    kinds = [cell.cell_type for cell in jupytext.read(path).cells]
    assert kinds[0] == "markdown"
    assert kinds.count("code") >= 2
