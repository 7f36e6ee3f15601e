"""Published pages: what a run leaves for the documentation."""

from __future__ import annotations

import json

import pytest
from benchmarks import publish
from benchmarks.__main__ import main


@pytest.fixture
def pages(tmp_path, monkeypatch):
    monkeypatch.setattr(publish, "PAGES", tmp_path / "pages")
    return tmp_path / "pages"


RESULTS = {
    "seeds": [0, 1],
    "straight": {"psnr": 27.04321, "kept": True},
    "wavy": {"psnr": 29.5, "kept": False},
    "curve": list(range(100)),
}


def test_results_without_a_table_become_one(pages, tmp_path) -> None:
    page = publish.publish("moving", RESULTS, ["--seeds", "2", "--publish"], tmp_path, 12.4, "abc")
    text = page.read_text()
    assert text.startswith(publish.MARK)
    assert "- command: `hairstage bench moving --seeds 2`\n" in text
    assert "- commit: `abc`\n" in text
    assert "- seconds: 12 s\n" in text
    assert "|  | psnr | kept |\n| --- | --- | --- |\n| straight | 27.04 | True |\n" in text
    kept = json.loads((pages / "moving.json").read_text())
    assert "curve" not in kept["results"]
    assert publish.page_of(kept) == text


def test_the_table_that_a_benchmark_wrote_is_the_pages(pages, tmp_path) -> None:
    (tmp_path / "bsdf.md").write_text("| a |\n| --- |\n| 1 |\n")
    text = publish.publish("bsdf", RESULTS, [], tmp_path, 1.0, "abc").read_text()
    assert "| a |" in text
    assert "psnr" not in text


def test_a_quick_run_is_not_published(pages, tmp_path, capsys) -> None:
    assert main(["demo", "--quick", "--publish", "--out", str(tmp_path)]) == 1
    assert "--quick" in capsys.readouterr().err
    assert not pages.exists()
