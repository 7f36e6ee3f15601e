"""The benchmark's own measures: depths against their cost, the filter bank beside OpenCV's."""

from __future__ import annotations

from typing import Any

import numpy as np
from benchmarks.light_codes import study

from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.reconstruct_options import LightCodeOptions, LogGaborBank, SearchOptions


def test_opencvs_loop_gives_what_our_bank_gives() -> None:
    y, x = np.mgrid[:96, :96]
    image = np.sin(2 * np.pi * (0.17 * x + 0.09 * y)).astype(np.float32)
    bank = LogGaborBank(count=12, spread=1.0, wavelength=5.0)
    found = study.compare_filters(bank, image)
    assert found["difference"] < 0.03


def test_brute_force_agrees_with_itself_and_worse_searches_find_less(
    fibres: Any, monkeypatch: Any
) -> None:
    variants = {
        "candidates": {"1": {"candidates": 1}, "8": {"candidates": 8}, "all": {"candidates": 0}},
        "neighbours": {"1": {"neighbours": 1}},
    }
    monkeypatch.setattr(study, "VARIANTS", variants)
    options = LightCodeOptions(search=SearchOptions(lattice=1))
    inside = np.ones((16, 16, 16), bool)
    volume = VoxelGrid(np.full(3, -0.032), 4e-3, inside)
    found = study.study_depths(fibres.views, volume, fibres.strands, options, [0])
    candidates = found["candidates"]
    assert candidates["all"]["as_brute_force"] == 1
    assert candidates["1"]["as_brute_force"] <= candidates["8"]["as_brute_force"]
    assert candidates["8"]["as_brute_force"] > 0.95
    assert found["neighbours"]["1"]["right"] < candidates["8"]["right"]
