"""Line stereo on frames of few and of many paths: what it finds must not get less as noise does."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from appearance import HairScene, Sampling, render_olat
from appearance.render.smoothed import olat_smoothed
from benchmarks.light_codes.rig import PITCH, TARGETS, rig_text
from benchmarks.strand_truth import Ball, StrandTruth, write_hair_masks
from benchmarks.subjects import Subject, simulated
from reconstruction import (
    Capture,
    Model,
    Progress,
    Rig,
    Step,
    reconstruct,
    silent,
    write_obj,
    write_strands,
)
from reconstruction.arrays import Floats
from reconstruction.capture.folder import FrameRecord
from reconstruction.files.durable import write_json
from simulators.frames.frames import Sensor
from stage_service.config import load_rig_file

SIDE, CAMERAS = 112, 16
EXPOSURE, ALL_ON = 0.02, 0.15  # seconds; level
DEPTH = 16


@dataclass(frozen=True)
class Frames:
    """`spp` paths a pixel, light between fibres `smoothed` as the simulated rig does it, and read
    by the `sensor` or as they are."""

    spp: int
    smoothed: bool = False
    sensor: bool = True

    def __str__(self) -> str:
        smooth = ", light between fibres smoothed" * self.smoothed
        return f"{self.spp} paths{smooth}{'' if self.sensor else ', no sensor noise'}"


ROWS = (Frames(12), Frames(96), Frames(96, sensor=False), Frames(12, smoothed=True))
QUICK = (Frames(1),)


class RenderedCapture(Capture):
    """A capture whose frames are rendered as they are read; of one camera they are kept."""

    @classmethod
    def write(cls, folder: Path, rig: Rig, subject: Subject, frames: Frames, seed: int) -> Capture:
        """Write the plan, rig and head: single lights and a frame of all of them."""
        folder.mkdir(parents=True)
        write_json(folder / "rig.json", rig.to_dict())
        steps = [Step(0, "all_on", EXPOSURE, ALL_ON)]
        steps += [Step(k + 1, "olat", EXPOSURE, light=x.name) for k, x in enumerate(rig.lights)]
        write_json(folder / "plan.json", {"steps": [s.to_dict() for s in steps], "seed": seed})
        if subject.head is not None:
            write_obj(folder / "head.obj", subject.head)
        found = cls(folder)
        found._scene, found._frames, found._seed = subject.scene(), frames, seed
        return found

    def __init__(self, path: str | Path) -> None:
        super().__init__(path)
        self.records = {
            (s.index, c.name): FrameRecord(s.index, c.name, "rendered")
            for s in self.steps
            for c in self.rig.cameras
        }
        self._images: dict[str, Floats] = {}
        self._scene: HairScene
        self._frames: Frames
        self._seed: int

    def _read(self, step: Step, camera: str) -> tuple[Floats, dict[str, float | str]]:
        if camera not in self._images:
            self._images = {camera: self._rendered(camera)}
        images = self._images[camera]
        true = ALL_ON * images.sum(axis=0) if step.kind == "all_on" else images[step.index - 1]
        if not self._frames.sensor:
            return true, {}
        sensor, number = Sensor(), [c.name for c in self.rig.cameras].index(camera)
        counts = sensor.expose(true, EXPOSURE, (self._seed, number, step.index))
        per_count = 1 / (EXPOSURE * sensor.gain)
        full = per_count * (sensor.full_scale - sensor.black)
        return ((counts.astype(np.float32) - sensor.black) * np.float32(per_count)), {
            "fullScale": full
        }

    def _rendered(self, name: str) -> Floats:
        camera, lights, spp = self.rig.camera(name), self.rig.lights, self._frames.spp
        if self._frames.smoothed:
            return olat_smoothed(self._scene, camera, lights, Sampling(spp, DEPTH, self._seed))
        return render_olat(self._scene, camera, lights, spp=spp, max_depth=DEPTH, seed=self._seed)


def compare_frames(
    out: Path, *, seed: int = 0, quick: bool = False, progress: Progress = silent
) -> dict[str, Any]:
    """Scores of `photometric` on a patch of the wavy groom by the kind of its frames."""
    side, cameras, rows = (48, 4, QUICK) if quick else (SIDE, CAMERAS, ROWS)
    target = TARGETS["wavy"]
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "rig.toml").write_text(rig_text(target, side, cameras, side * PITCH))
        rig = load_rig_file(folder / "rig.toml").rig
        subject = simulated(folder / "rig.toml", "wavy", None, seed)
        write_strands(folder / "strands.npz", subject.strands)
        results: dict[str, Any] = {}
        for k, frames in enumerate(rows):
            progress(str(frames), k / len(rows))
            capture = RenderedCapture.write(folder / str(k), rig, subject, frames, seed)
            write_hair_masks(capture, folder)
            truth = StrandTruth(capture, folder, Ball(target, side * PITCH / 2), 10_000)
            model = Model(out / str(frames).replace(", ", "_").replace(" ", "_"))
            report = reconstruct(capture, model, method="photometric")
            results[str(frames)] = {
                **truth.score(model.strands()),
                "warnings": [w for s in report.stages for w in s.warnings],
            }
    return results
