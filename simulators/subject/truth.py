"""The ground truth of simulated frames, for evaluation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from reconstruction import write_obj, write_strands
from simulators.subject.drift import Drift
from simulators.subject.props import Prop
from simulators.subject.subject import Subject

EXPOSURES = "exposures.jsonl"
ABSORPTION = "absorption.npy"


def write_truth(folder: Path, subject: Subject | Prop, drift: Drift) -> None:
    """Write `strands.npz`, `head.obj` (where there is one), `appearance.json`, `poses.json`, and
    `absorption.npy` of a subject whose strands differ.

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
    (folder / "poses.json").write_text(json.dumps(drift.to_dicts(), indent=1) + "\n")
