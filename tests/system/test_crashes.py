"""Killed without warning: the worker in mid-job, the service in mid-capture."""

from __future__ import annotations

import re
from pathlib import Path

from waiting import until

from reconstruction import Capture


def test_a_job_outlives_its_worker(stage):
    stage.simulate()
    stage.serve()
    worker = stage.work()
    capture = stage.capture(
        {
            **stage.subject(),
            "pipeline": stage.pipeline(held_out_lights=["light_004"]),
        }
    )
    path = f"/jobs/{capture['job']}"
    stage.until(lambda: (stage.get(path)["progress"] or {}).get("step") == "fit", 100)
    worker.kill()
    worker.wait()
    assert stage.get(path)["state"] == "running"
    assert stage.get("/health")["worker"] is False
    strands = Path(stage.get(path)["model"]) / "strands.npz"
    written = strands.stat().st_mtime_ns
    stage.work()
    stage.until(lambda: stage.get(path)["state"] == "done", 200)
    job = stage.get(path)
    assert (job["outcome"], job["error"]) == ("succeeded", None)
    assert strands.stat().st_mtime_ns == written, "reconstruction was done, and was done again"
    assert (strands.parent / "results.json").is_file()


def test_a_killed_service_leaves_no_lamp_lit_and_every_finished_frame(stage):
    pulse = 8
    stage.simulate([{"device": "trigger", "kind": "silent", "pulse": pulse}])
    service = stage.serve()
    capture = stage.post("/captures", {})
    stage.until(lambda: stage.get(f"/captures/{capture['id']}")["step"] == pulse - 1)
    # The service now waits for the trigger box's answer, and the lamp is on.
    stage.until(lambda: stage.lamps_lit() == 1)
    service.kill()
    service.wait()
    assert stage.lamps_lit() == 1
    until(lambda: stage.lamps_lit() == 0, stage.watchdog_s + 1.0 * stage.slack)

    path = Path(capture["path"])
    left = Capture(path)
    frames = [r for r in left.records.values() if r.file is not None]
    assert len(frames) >= stage.CAMERAS * (pulse - 2)
    for record in frames:
        assert left.frame(left.steps[record.step], record.camera).shape == (24, 24, 3)
    problems = stage.verify(path)
    missing = stage.FRAMES - len(frames)
    assert problems[:2] == [
        "manifest.json is missing: the capture was not finished.",
        f"{missing} planned frames were never shot; the first is step "
        f"{len(frames) // stage.CAMERAS} (olat), cam_{len(frames) % stage.CAMERAS}.",
    ]
    assert all("are in no line of the journal" in left_over for left_over in problems[2:])
    stage.serve()
    known = stage.get(f"/captures/{capture['id']}")
    assert (known["state"], known["outcome"]) == ("done", "interrupted")
    assert known["frames_written"] == len(frames)


def test_inverse_rendering_goes_on_where_its_worker_was_killed(stage):
    stage.simulate()
    stage.serve()
    worker = stage.work()
    made = stage.capture({**stage.subject(), "pipeline": stage.pipeline()})
    model = Path(stage.get(f"/jobs/{made['job']}")["model"]).name
    stage.until(lambda: stage.get(f"/jobs/{made['job']}")["state"] == "done", 200)
    effort = {"pixels": 60, "spp": 4, "gradient_spp": 2}
    fit = {
        "variant": "correctives",
        "shape": [2, 2, 2],
        "steps": 80,
        "check_every": 5,
        "halvings": 99,
    }
    asked = {
        "capture": made["id"],
        "model": model,
        "pipeline": {
            "name": "appearance",
            "options": {
                "fit": {"iterations": 2},
                "inverse_rendering": {
                    "judged_spp": 4,
                    "max_depth": 4,
                    "fit": fit | {"effort": effort},
                },
                "assess": {"relit_size": 32, "relit_spp": 4},
            },
        },
    }
    path = f"/jobs/{stage.post('/jobs', asked)['id']}"

    def step() -> int:
        """The step of the fit that the job tells, with its current error; 0 before the volume's."""
        progress = stage.get(path)["progress"] or {"what": "", "step_share": 0.0}
        told = re.match(r"step (\d+): error \d", progress["what"])
        return int(told[1]) if told and progress["step_share"] > 0.3 else 0

    reached = stage.until(lambda: (n := step()) >= 20 and n, 200)
    worker.kill()
    worker.wait()
    stage.work()
    stage.until(lambda: step() == 0, 100)  # until then, what the killed worker had told
    assert stage.until(step, 100) >= reached
    stage.until(lambda: stage.get(path)["state"] == "done", 300)
    job = stage.get(path)
    assert (job["outcome"], job["error"]) == ("succeeded", None)
    # by name: what validation speaks against lies in a folder of its own
    found = {Path(a["path"]).name for a in stage.get(f"{path}/artifacts")}
    assert {"hair_maps.npz", "lights.json", "report.json"} <= found
