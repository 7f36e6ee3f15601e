"""The demo's last screen, from the figures of recorded runs."""

from __future__ import annotations

from typing import Any

from stage_service.cli.demo_screen import last_screen


def scores(f: float) -> dict[str, Any]:
    return {"visible": {"1mm_10deg": {"f": f}}}


def psnr(**images: float) -> dict[str, Any]:
    return {name: {"psnr": value, "ssim": 0.4} for name, value in images.items()}


RESULTS = {
    "subject": "wavy",
    "seed": 0,
    "rig": "demo",
    "seconds": 862.4,
    "capture": {"seconds": 199.0},
    "stages": {"reconstruct": 237.2, "fit": 132.7, "inverse_rendering": 82.6, "assess": 436.5},
    "geometry": {**scores(0.246), "lengths": {"pred": {"strands": 13277, "total_m": 2019.4}}},
    "baselines": {
        "true_directions": scores(0.443),
        "hull_smooth_field": scores(0.032),
        "hull_vertical": scores(0.022),
    },
    "images": {
        "held_out_lights": psnr(
            ours=20.4, from_frames=27.6, diffuse=15.3, mean_colour=12.4, three_nearest=26.1
        ),
        "held_out_camera": psnr(ours=19.4, sun_fit=19.4, diffuse=14.3, mean_colour=11.4),
    },
    "appearance": {
        "fitted": {"beta_m": 0.319, "beta_m_interval": [0.161, 0.354]},
        "true": {"beta_m": 0.28},
    },
    "warnings": [
        "strands: 352 strands could not be connected to the scalp and were removed.",
        "masks: 19 % of the pixels of cam_07 contradict other cameras: check its pose.",
    ],
}


def test_the_result_three_figures_with_their_best_baselines_and_what_to_open(tmp_path):
    lines = last_screen(RESULTS, tmp_path).splitlines()
    assert "13,277 strands, 2,019 m; beta_m 0.32 (95 % interval 0.16 to 0.35), true 0.28" in lines
    figures = [line.split() for line in lines if line.startswith(("strands: F", "images: "))]
    assert [(row[-1], *row[-2:-1]) for row in figures] == [
        ("field", "smooth"), ("lights", "nearest"), ("diffuse", "dB,")
    ]  # fmt: skip
    assert "24.6" in figures[0]
    assert "3.2" in figures[0]
    assert "44.3" not in figures[0], "the true directions are a bound, no baseline"
    assert {"20.4", "26.1"} <= set(figures[1])
    assert {"19.4", "14.3"} <= set(figures[2])
    text = "\n".join(lines)
    assert "check its pose" in text
    assert "1; 1 more on the model's page" in text
    assert "352 strands" not in text, "it asks for no action"
    for path in ("model/index.html", "model/relit.png", "truth/strands.npz"):
        assert path in text


def test_it_has_at_most_25_lines_however_many_warnings_there_are(tmp_path):
    many = [f"masks: {n} pixels {'and others ' * 40}: check the poses" for n in range(30)]
    lines = last_screen({**RESULTS, "warnings": many}, tmp_path).splitlines()
    assert len(lines) <= 25
    assert any(line.startswith("Warnings to act on: 30") for line in lines)


def test_light_that_turns_is_named_if_there_is_any(tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "relit.webp").touch()
    assert "relit.webp: the hair under a turning" in last_screen(RESULTS, tmp_path)
