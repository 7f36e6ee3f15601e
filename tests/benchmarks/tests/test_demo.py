"""The table over demos, from results that were recorded."""

from __future__ import annotations

import json
from typing import Any

import pytest
from benchmarks.demo import demo_columns, figures_of, markdown_table


def strands(f: float) -> dict[str, Any]:
    return {over: {"1mm_10deg": {"f": f}} for over in ("visible", "all")}


def results(seed: int = 3, beta_m: float = 0.887, **more: Any) -> dict[str, Any]:
    return {
        "subject": "curly",
        "seed": seed,
        "geometry": {**strands(0.253), "equal_length": strands(0.204)},
        "baselines": {"hull_vertical": strands(0.022)},
        "images": {"held_out_camera": {"ours": {"psnr": 21.44, "ssim": 0.706}}},
        "appearance": {
            "fitted": {"beta_m": beta_m, "sigma_a": [0.11, 0.15, 0.5]},
            "true": {"beta_m": 0.28, "sigma_a": [0.1, 0.2, 0.45]},
        },
        "warnings": [f"fit: the roughness is at its bound, {seed}"],
        **more,
    }


@pytest.fixture
def columns(tmp_path):
    """`columns(*results)`: of files with these results."""

    def of(*found: Any) -> dict[str, list[dict[str, Any]]]:
        files = [tmp_path / f"{k}.json" for k in range(len(found))]
        for file, one in zip(files, found, strict=True):
            file.write_text(one if isinstance(one, str) else json.dumps(one))
        return demo_columns(files)

    return of


def test_seeds_of_a_subject_are_a_mean_with_its_spread(columns):
    found = columns(results(3), results(4, beta_m=0.287))
    head, _, *rows = markdown_table(found).splitlines()
    assert head == "|  | curly, seeds 3, 4 [1] |"
    assert "| F at 1 mm/10°, visible points: ours | 25.3 ± 0.0 % |" in rows
    assert "| F at 1 mm/10°, visible points, at equal length: ours | 20.4 ± 0.0 % |" in rows
    assert "| held-out camera: ours | 21.4 ± 0.0 dB / 0.71 ± 0.00 |" in rows
    assert "| σ_a, the channel that is furthest off | 25 ± 0 % |" in rows
    assert rows[-1] == "[1] fit: the roughness is at its bound, 3 (seed 3, 4)"
    (spread,) = figures_of(found["curly, seeds 3, 4"])["β_M to render these strands with"]
    assert spread == pytest.approx({"mean": 0.587, "std": 0.3 * 2**0.5, "n": 2})
