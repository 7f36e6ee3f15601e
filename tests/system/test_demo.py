"""`hairstage demo` on the tiny rig: every figure it promises, and nothing left behind."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

DEMO_RIG = Path(__file__).resolve().parents[2] / "stage_service" / "rigs" / "demo.toml"


def command(stage, out: Path, *subject: str) -> list[str]:
    words = [sys.executable, "-m", "stage_service.cli", "demo", "--json", "--rig", str(stage.rig)]
    return [*words, "--subject", *subject, "--out", str(out)]


def processes_of(out: Path) -> list[int]:
    """Processes that name the folder on their command line."""
    found = []
    for cmdline in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if str(out).encode() in cmdline.read_bytes():
                found.append(int(cmdline.parent.name))
        except OSError:
            continue  # it ended while we looked
    return found


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_demo_leaves_every_figure_and_no_process(stage):
    out = stage.folder / "demo"
    rig = DEMO_RIG.read_text()
    for large, small in (("= 160\n", "= 64\n"), ("= 331\n", "= 60\n")):
        assert large in rig
        rig = rig.replace(large, small)
    stage.rig.write_text(rig)
    done = subprocess.run(command(stage, out, "wavy"), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    results = json.loads((out / "results.json").read_text())
    assert json.loads(done.stdout) == results
    assert results["seconds"] > 1
    thresholds = {"1mm_10deg", "2mm_20deg", "3mm_30deg"}
    for figures in (results["geometry"], *results["baselines"].values()):
        for over in ("visible", "all"):
            assert set(figures[over]) == thresholds
            for scores in figures[over].values():
                assert all(0 <= scores[k] <= 1 for k in ("precision", "recall", "f"))
    assert set(results["baselines"]) == {"hull_vertical", "hull_smooth_field", "true_directions"}
    assert results["images"]["rendered"] in ("sun_fit", "inverse_rendering")
    fits = ["ours", "mean_colour", "diffuse"]
    if results["images"]["rendered"] == "inverse_rendering":
        fits += ["sun_fit", "inverse_rendering"]
    for group, of_frames in (
        ("held_out_lights", ("three_nearest", "from_frames")),
        ("held_out_camera", ("nearest_cameras", "three_nearest_own_frames")),
    ):
        for method in (*fits, *of_frames):
            assert results["images"][group][method]["psnr"] > 0
            assert -1 <= results["images"][group][method]["ssim"] <= 1
    fitted, true = results["appearance"]["fitted"], results["appearance"]["true"]
    assert set(fitted) > set(true) >= {"beta_m", "v", "colour", "skin"}
    assert results["held_out"]["held_out_cameras"] == ["cam_07"]
    for name in ("strands.npz", "strands.hair", "strands.usdc", "appearance.json", "report.json"):
        assert (out / "model" / name).is_file(), name
    assert (out / "capture" / "manifest.json").is_file()
    assert list((out / "model" / "plots").iterdir())
    assert processes_of(out) == []


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_quick_demo_is_labelled_and_names_its_result_before_the_comparisons(tmp_path):
    out = tmp_path / "demo"
    words = [sys.executable, "-m", "stage_service.cli", "demo", "--quick", "--out", str(out)]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    label = json.loads((out / "results.json").read_text())["label"]
    assert label.startswith("quick demo: 24 lights")
    assert label in done.stdout
    assert label in (out / "model" / "index.html").read_text()
    assert "rendering camera " in done.stderr
    strands, page, compared = (
        done.stderr.index(text) for text in ("strands: /", "index.html", "evaluate")
    )
    assert strands < page < compared
    assert processes_of(out) == []


@pytest.mark.slow
def test_ctrl_c_ends_the_demo_in_order_and_its_folder_may_be_used_again(stage):
    out = stage.folder / "demo"
    old = out / "captures" / "old"
    # Large enough that the rendering of the first lamp takes its time.
    stage.rig.write_text(stage.rig.read_text().replace("= 24\n", "= 96\n"))
    interrupt(stage, out, lambda: bool(list(out.glob("captures/*/frames/*/*"))))
    (manifest,) = out.glob("captures/*/manifest.json")
    assert json.loads(manifest.read_text())["outcome"] == "aborted"
    manifest.parent.rename(old)  # what an earlier demo left is to be replaced
    interrupt(stage, out, lambda: not old.exists())


def interrupt(stage, out: Path, when: Callable[[], bool]) -> None:
    """Ctrl-C to a demo in `out` once `when` says so: it ends in order."""
    with subprocess.Popen(
        command(stage, out, "straight"), stdout=subprocess.PIPE, text=True
    ) as begun:
        try:
            stage.until(lambda: begun.poll() is not None or when())
            begun.send_signal(signal.SIGINT)
            output, _ = begun.communicate(timeout=300)
        finally:
            begun.kill()
    assert begun.returncode == 130, output
    assert json.loads(output)["error"]["type"] == "Interrupted"
    assert processes_of(out) == []
