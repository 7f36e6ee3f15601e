"""The ground truth of simulated frames, for evaluation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from reconstruction import write_obj, write_strands
from simulators.subject.clothing import PARTS
from simulators.subject.drift import Drift
from simulators.subject.props import Prop
from simulators.subject.subject import Subject

EXPOSURES = "exposures.jsonl"
ABSORPTION = "absorption.npy"
DRESSED = "dressed.npz"


def write_truth(folder: Path, subject: Subject | Prop, drift: Drift) -> None:
    """Write `strands.npz`, `head.obj` (where there is one), `appearance.json`, `poses.json`,
    `absorption.npy` of a subject whose strands differ, and `dressed.npz` of one with clothes: all
    that is rendered but hair, and how many of the last strands are its `beard`.

    All at pose 0; for a prop `prop.json` instead. `exposures.jsonl`, created empty here and written
    by `World`, has the pose of each pulse.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / EXPOSURES).write_text("")
    if not isinstance(subject, Subject):
        (folder / "prop.json").write_text(json.dumps(subject.to_dict(), indent=1) + "\n")
        return
    write_strands(folder / "strands.npz", subject.strands)
    if subject.head is not None:
        write_obj(folder / "head.obj", subject.head)
    appearance = {"hair": subject.hair.to_dict(), "skin": list(subject.skin)}
    (folder / "appearance.json").write_text(json.dumps(appearance, indent=1) + "\n")
    if subject.absorption is not None:
        np.save(folder / ABSORPTION, subject.absorption.astype(np.float32))
    if (worn := subject.dressed) is not None:
        np.savez(
            folder / DRESSED,
            vertices=worn.mesh.vertices,
            faces=worn.mesh.faces,
            part=worn.part,
            parts=PARTS,
            albedo=worn.materials.albedo,
            shine=worn.materials.shine,
            beard=subject.beard,
        )
    (folder / "poses.json").write_text(json.dumps(drift.to_dicts(), indent=1) + "\n")
