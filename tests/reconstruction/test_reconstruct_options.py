"""Options of a reconstruction are checked where they arrive, at any depth."""

from __future__ import annotations

import subprocess
import sys

import pytest
from pydantic import ValidationError

from reconstruction import ReconstructOptions, parse_options
from reconstruction.reconstruct_options import LogGaborBank


def test_the_old_name_of_a_field_is_read() -> None:
    made = parse_options(ReconstructOptions, {"refine": {"worth": 0.1}})
    assert made.refine.marginal_coverage == 0.1


def test_errors_of_positional_options_name_their_field() -> None:
    assert LogGaborBank(4.0, 12) == LogGaborBank(wavelength=4.0, count=12)
    with pytest.raises(ValidationError) as caught:
        LogGaborBank(4.0, 1)
    assert caught.value.errors()[0]["loc"] == ("count",)
    with pytest.raises(TypeError, match="multiple values"):
        LogGaborBank(4.0, wavelength=5.0)  # type: ignore[misc]


def test_options_are_checked_without_what_methods_need() -> None:
    code = (
        "import sys, reconstruction.reconstruct_options;"
        "sys.exit(' '.join({'numpy', 'scipy', 'cv2', 'drjit'} & set(sys.modules)) or 0)"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")
