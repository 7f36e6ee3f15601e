"""From a REST call to relit hair: three processes, HTTP and the wires."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np


def modes(root: Path) -> dict[str, set[int]]:
    """The permissions of all that lies in and under `root`."""
    found: dict[str, set[int]] = {"folder": {root.stat().st_mode & 0o777}, "file": set()}
    for path in root.rglob("*"):
        found["folder" if path.is_dir() else "file"].add(path.stat().st_mode & 0o777)
    return found


OPTIONS = {"held_out_cameras": ["cam_2"], "held_out_lights": ["light_004"]}


def test_a_capture_becomes_relit_hair(running):
    cost = running.post("/plans:validate", {})
    assert cost["frames"] == running.FRAMES
    capture = running.capture(
        {
            **running.subject(),
            "pipeline": running.pipeline(**OPTIONS),
        }
    )
    assert (capture["outcome"], capture["error"]) == ("completed", None)
    assert (capture["frames_written"], capture["frames_missing"]) == (running.FRAMES, 0)
    assert running.lamps_lit() == 0
    assert modes(running.root) == {"folder": {0o750}, "file": {0o640}}  # people's faces
    assert running.verify(Path(capture["path"])) == []

    # Each lamp lights something else: the commanded state makes the picture, nothing else does.
    pictures = []
    for step in range(2, 6):
        png = running.http.get(f"/captures/{capture['id']}/frames/{step}/cam_1.png").content
        pictures.append(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR))
    assert len({p.tobytes() for p in pictures}) == 4

    assert running.get(f"/jobs/{capture['job']}")["state"] == "queued"
    running.work()
    running.until(lambda: running.get(f"/jobs/{capture['job']}")["state"] == "done", 200)
    job = running.get(f"/jobs/{capture['job']}")
    assert job["outcome"] == "succeeded", job["error"]
    files = {a["path"]: a["bytes"] for a in running.get(f"/jobs/{job['id']}/artifacts")}
    for name in ("strands.npz", "strands.hair", "strands.usdc", "appearance.json"):
        assert files[name] > 100
    for name in ("comparison.png", "relit.png", "results.json", "report.json"):
        assert files[name] > 100
    assert any(name.startswith("plots/") for name in files)
    report = running.get(f"/jobs/{job['id']}/report")
    assert all(stage["seconds"] >= 0 for stage in report["stages"])
    results = running.get(f"/jobs/{job['id']}/artifacts/results.json")
    for group in ("held_out_lights", "held_out_camera"):
        assert {"ours", "mean_colour", "diffuse"} <= set(results["images"][group])
    # Compressed in the background, and still sound.
    assert running.verify(Path(capture["path"])) == []
    assert len(list(Path(capture["path"]).glob("frames/*/*.zip.exr"))) == running.FRAMES
    assert len(running.get("/devices")["cameras"]) == running.CAMERAS
