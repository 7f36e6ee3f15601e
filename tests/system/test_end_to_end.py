"""From a REST call to relit hair: three processes, HTTP and the wires; and kills in between."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest


def modes(root: Path) -> dict[str, set[int]]:
    """The permissions of all that lies in and under `root`."""
    found: dict[str, set[int]] = {"folder": {root.stat().st_mode & 0o777}, "file": set()}
    for path in root.rglob("*"):
        found["folder" if path.is_dir() else "file"].add(path.stat().st_mode & 0o777)
    return found


HELD_OUT = {"held_out_cameras": ["cam_2"], "held_out_lights": ["light_004"]}


@pytest.fixture(scope="module")
def captured(running):
    """A capture that asked for the whole pipeline; no worker has begun it yet."""
    assert running.post("/plans:validate", {})["frames"] == running.FRAMES
    return running.capture({**running.subject(), "pipeline": running.pipeline(**HELD_OUT)})


@pytest.fixture(scope="module")
def finished(running, captured):
    """Its job, whose first worker was killed while it fitted, and when the strands were written."""
    path = f"/jobs/{captured['job']}"
    assert running.get(path)["state"] == "queued"
    worker = running.work()
    running.until(lambda: (running.get(path)["progress"] or {}).get("step") == "fit", 100)
    worker.kill()
    worker.wait()
    assert running.get(path)["state"] == "running"
    assert running.get("/health")["worker"] is False
    written = (Path(running.get(path)["model"]) / "strands.npz").stat().st_mtime_ns
    running.work()
    running.until(lambda: running.get(path)["state"] == "done", 200)
    return running.get(path), written


def test_a_capture_has_every_frame_each_of_its_own_lamp(running, captured):
    assert (captured["outcome"], captured["error"]) == ("completed", None)
    assert (captured["frames_written"], captured["frames_missing"]) == (running.FRAMES, 0)
    assert running.lamps_lit() == 0
    assert modes(running.root) == {"folder": {0o750}, "file": {0o600, 0o640}}  # people's faces
    assert running.verify(Path(captured["path"])) == []

    # Each lamp lights something else: the commanded state makes the picture, nothing else does.
    pictures = []
    for step in range(2, 6):
        png = running.http.get(f"/captures/{captured['id']}/frames/{step}/cam_1.png").content
        pictures.append(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR))
    assert len({p.tobytes() for p in pictures}) == 4


def test_while_the_rig_renders_the_service_says_what_it_waits_for_and_how_long(running, captured):
    assert captured["progress"] is None
    waited_for = [p for p in running.waited_for if p["waiting"]["doing"]]
    assert {p["waiting"]["doing"] for p in waited_for} & {
        f"rendering camera {k} of {running.CAMERAS}" for k in range(1, running.CAMERAS + 1)
    }
    assert all(p["seconds_left"] > 0 for p in waited_for)
    assert sorted(p["share"] for p in waited_for) == [p["share"] for p in waited_for]


def test_a_job_outlives_its_worker(finished):
    job, written = finished
    assert (job["outcome"], job["error"]) == ("succeeded", None)
    strands = Path(job["model"]) / "strands.npz"
    assert strands.stat().st_mtime_ns == written, "reconstruction was done, and was done again"


def test_a_capture_becomes_relit_hair(running, captured, finished):
    job, _ = finished
    files = {a["path"]: a["bytes"] for a in running.get(f"/jobs/{job['id']}/artifacts")}
    for name in ("strands.npz", "strands.hair", "strands.usdc", "appearance.json"):
        assert files[name] > 100
    for name in ("comparison.png", "relit.png", "results.json", "report.json", "index.html"):
        assert files[name] > 100
    assert any(name.startswith("plots/") for name in files)
    report = running.get(f"/jobs/{job['id']}/report")
    assert all(stage["seconds"] >= 0 for stage in report["stages"])
    results = running.get(f"/jobs/{job['id']}/artifacts/results.json")
    for group in ("held_out_lights", "held_out_camera"):
        assert {"ours", "mean_colour", "diffuse"} <= set(results["images"][group])
    # Compressed in the background, and still sound.
    assert running.verify(Path(captured["path"])) == []
    assert len(list(Path(captured["path"]).glob("frames/*/*.zip.exr"))) == running.FRAMES
    assert len(running.get("/devices")["cameras"]) == running.CAMERAS
