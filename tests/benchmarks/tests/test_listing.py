"""The benchmark of many captures: it measures a root of as many, and they are sound."""

from __future__ import annotations

from dataclasses import replace

from benchmarks.acquisition.listing import fill, measure

from stage_service.acquisition.states import read_status
from stage_service.cli.support.commands import rig_path
from stage_service.config import load_rig_file


def test_starts_and_pages_of_sound_captures_are_measured(tmp_path):
    rig_file = replace(load_rig_file(rig_path("demo")), devices=None)
    result = measure(tmp_path / "root", rig_file, 3)
    assert (result["captures"], result["page"]) == (3, 3)
    assert 0 < result["page_s"] <= result["page_slowest_s"]
    assert 0 < result["first_start_s"] <= result["first_read_s"]
    assert 0 < result["start_s"] <= result["read_s"]
    fill(tmp_path / "more", rig_file, 2)
    for folder in (tmp_path / "more").iterdir():
        assert (read_status(folder).outcome, read_status(folder).frames_written) == ("completed", 2)
