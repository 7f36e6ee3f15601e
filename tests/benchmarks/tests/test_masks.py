"""What the masks' benchmark says of its figures."""

from __future__ import annotations

from typing import Any

from benchmarks.light_planes.masks import report


def test_the_spread_is_over_the_seeds_of_the_reconstruction() -> None:
    def visible(f: float) -> dict[str, Any]:
        return {f"{n}mm_{n}0deg": {"f": f} for n in (1, 2, 3)}

    job = {
        "geometry": {"visible": visible(0.25), "all": visible(0.1)},
        "baselines": {},
        "images": {"held_out_lights": {}, "held_out_camera": {}},
        "appearance": {"fitted": {"beta_m": 0.3}, "true": {"beta_m": 0.28}},
        "warnings": ["masks: cam_1 disagrees"],
    }
    judged = {
        "automatic": {"overlap": {"cam_0": 0.97, "cam_1": 0.9512}},
        "jobs": {"automatic": job, "true": job},
        "drawn_again": [{"visible": visible(0.27)}],
    }
    said = report({"wavy": {"16": judged, "64": {**judged, "drawn_again": []}}}, 0).splitlines()
    assert said[0] == "- wavy, 16 paths: masks overlap by 0.951 at least"
    assert said[1] == "  - F 1 mm/10° of visible points: 26.0 ± 1.4 over 2 seeds"
    assert "  - F 1 mm/10° of visible points: 25.0" in said, "of one seed no spread is known"
    assert "| F at 1 mm/10°, visible points: ours | 25.0 % | 25.0 % | 25.0 % | 25.0 % |" in said
