"""The demo, and the quick demo with fewer lights, pixels and samples."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reconstruction.reading import read_json
from stage_service.cli.support.commands import BadArgument
from stage_service.jobs.pipelines import PIPELINES, SECONDS


@dataclass(frozen=True)
class DemoKind:
    """The job's pipeline and options, and options of the simulated rig.

    `capture_s` and `steps_s` are durations on two cores: of the capture, start of the processes
    included, and of the job's steps, in their order, until the figures are there.
    """

    pipeline: str
    options: Mapping[str, Any]
    capture_s: float
    steps_s: Mapping[str, float]
    label: str = ""
    simulator: tuple[str, ...] = ()

    @property
    def job_options(self) -> dict[str, Any]:
        """The options with the label; a job takes no empty label."""
        return {**self.options, **({"label": self.label} if self.label else {})}


FULL = DemoKind(
    "full",
    {
        "stages": ["sun", "shared", "spatial", "lights", "field"],
        "assess": {"turning_frames": 36},
    },
    720.0,
    {step: SECONDS[step] for step in PIPELINES["full"] if step != "compress"},
)
LIGHTS, PIXELS, ROWS, TRACKING_EVERY = 24, 80, 24, 24
_SIZE = f"{LIGHTS} lights, {PIXELS} × {PIXELS} pixels"
QUICK = DemoKind(
    "light_planes",
    {
        "reconstruct": {
            "roots": 2000,
            "grid": 3e-3,
            "refine": {"steps": 0, "marginal_coverage": 0},
        },
        "fit": {"hair_pixels": 300, "roughness_spp": 6, "colour_spp": 8, "iterations": 2},
        "assess": {"cameras": 1, "lights": 2, "spp": 8, "relit_size": 256},
        "baselines": False,
    },
    27.0,
    {"reconstruct": 21, "fit": 11, "relight": 5, "assess": 12, "evaluate": 14, "results": 1},
    f"quick demo: {_SIZE}; figures are not those of the full demo",
    ("--spp", "8"),
)


def quick_rig(path: Path) -> dict[str, Any]:
    """The rig file at `path` with fewer lights, pixels and rows, for a JSON file.

    Raises `BadArgument` unless its lights are a dome and its devices have a field of view.
    """
    data: dict[str, Any]
    data = read_json(path) if path.suffix == ".json" else tomllib.loads(path.read_text())
    devices = [*data.get("cameras", ()), *data.get("projectors", ())]
    if "dome" not in data or not all("fov_deg" in device for device in devices):
        raise BadArgument(
            f"{path}: --quick needs a rig file with [dome] and fov_deg of each device"
        )
    data["dome"]["lights"] = LIGHTS
    data.setdefault("capture", {})["tracking_every"] = TRACKING_EVERY
    for kind, size in (("cameras", PIXELS), ("projectors", ROWS)):
        for device in data.get(kind, ()):
            device["width"] = device["height"] = size
    return data
