"""What `import stage_service` gives, and what it does not load."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import stage_service


def test_a_plan_is_costed_by_public_names_alone():
    rig = Path(stage_service.__file__).with_name("rigs") / "demo.toml"
    rig_file = stage_service.load_rig_file(rig)
    plan = stage_service.resolve(stage_service.CapturePlan(projectors=()), rig_file)
    assert plan.cost.frames == len(plan.steps) * len(rig_file.rig.cameras)
    assert all(getattr(stage_service, name) for name in stage_service.__all__)
    assert not hasattr(stage_service, "Stage")


def test_the_package_loads_modules_on_first_use_of_a_name():
    code = (
        "import sys, stage_service; print([m for m in ('pydantic', 'numpy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
