"""Subjects with their truth: from the simulators, and from the capture that Cycles rendered."""

from __future__ import annotations

import json
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from appearance import HairAppearance, HairScene, build_scene
from appearance.bsdf.maps import HairMaps, MappedStrands
from reconstruction import Mesh, Strands, read_obj, read_strands
from reconstruction.arrays import Array
from reconstruction.tangents.line_evidence import half_sphere
from stage_service.cli.support.children import SimulatedRig
from stage_service.cli.support.commands import FAILED, CommandError


@dataclass(frozen=True)
class Subject:
    """What is rendered."""

    strands: Strands
    head: Mesh | None
    hair: HairAppearance
    skin: tuple[float, float, float]
    absorption: Array | None = None

    def scene(self) -> HairScene:
        """The scene, ready to render."""
        scene = build_scene(self.strands, self.head, hair=self.hair, skin=self.skin)
        if self.absorption is None:
            return scene
        maps = HairMaps.each(self.hair, self.absorption)
        return MappedStrands.alone(scene, self.strands).with_maps(maps)


def simulated(rig: Path, name: str, head: Path | None, seed: int) -> Subject:
    """The simulators' subject: a procedural one's name, or a strand file with its head.

    Only they may import it, so they write it to a folder. Raises `CommandError`.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = SimulatedRig(rig, name, head, seed).command("--truth-only", folder)
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            lines = done.stderr.strip().splitlines()
            raise CommandError(f"simulators: {lines[-1] if lines else 'failed'}", FAILED)
        return true_subject(Path(folder))


def true_subject(truth: Path) -> Subject:
    """The subject whose truth the simulators wrote to a folder."""
    appearance, head = json.loads((truth / "appearance.json").read_text()), truth / "head.obj"
    each = truth / "absorption.npy"
    return Subject(
        read_strands(truth / "strands.npz"),
        read_obj(head) if head.is_file() else None,
        HairAppearance.from_dict(appearance["hair"]),
        tuple(appearance["skin"]),
        np.load(each) if each.is_file() else None,
    )


def cycles_subject(folder: Path) -> tuple[Subject, dict[str, Any]]:
    """The truth of the capture that Cycles rendered, and all of its `params.json`.

    Strands and the elliptic head are in `strands_gt.npz`. Raises `OSError` for a missing file.
    """
    params = json.loads((folder / "params.json").read_text())
    truth = np.load(folder / "strands_gt.npz")
    hair = HairAppearance(
        params["sigma_a"], params["beta_m"], params["beta_n"], params["ior"], params["tilt_deg"]
    )
    directions = np.concatenate([half_sphere(8000), -half_sphere(8000)])
    faces = ConvexHull(directions).simplices.astype(np.int64)
    head = Mesh(truth["head_center"] + truth["head_axes"] * directions, faces)
    strands = Strands(truth["points"], truth["offsets"], float(truth["radius"]))
    return Subject(strands, head, hair, params["head_albedo"]), params
