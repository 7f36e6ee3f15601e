"""The public names of the floors are there, and importing a floor imports no library."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module

import pytest

HEAVY = {"numpy", "scipy", "cv2", "drjit", "OpenEXR", "pxr", "pydantic", "appearance.sun_fit.fit"}


@pytest.mark.parametrize("floor", ["reconstruction", "appearance", "stage_service"])
def test_names_are_there_and_load_modules_on_first_use(floor: str) -> None:
    assert all(getattr(import_module(floor), name) for name in import_module(floor).__all__)
    heavy = HEAVY - ({"numpy", "drjit", "scipy"} if floor == "appearance" else set())
    code = f"import sys, {floor}; sys.exit(' '.join({heavy} & set(sys.modules)) or 0)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")
