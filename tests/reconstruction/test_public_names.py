"""The public names of the ground floor: all there, and none costs its library at start."""

from __future__ import annotations

import subprocess
import sys

import reconstruction

HEAVY = {"numpy", "scipy", "cv2", "drjit", "OpenEXR", "pxr"}


def test_every_public_name_is_there() -> None:
    for name in reconstruction.__all__:
        found = getattr(reconstruction, name)
        assert name == "Progress" or found.__name__ == name  # the one that is a type's alias
    assert {"Capture", "Model", "reconstruct", "Strands"} <= set(reconstruction.__all__)


def test_importing_the_floor_imports_no_library() -> None:
    code = f"import sys, reconstruction; sys.exit(' '.join({HEAVY} & set(sys.modules)) or 0)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")
