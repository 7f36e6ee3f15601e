"""Options of a reconstruction are checked where they arrive, at any depth."""

from __future__ import annotations

import math
import subprocess
import sys

import pytest
from pydantic import ValidationError

from reconstruction import BadOptions, ReconstructOptions, parse_options
from reconstruction.reconstruct_options import LogGaborBank


def test_nested_json_fills_in_the_defaults() -> None:
    made = parse_options(
        ReconstructOptions,
        {"held_out": ["c1"], "measure": {"bank": {"wavelength": 4}}},
    )
    assert made.held_out == ("c1",)
    assert made.measure.bank.wavelength == 4.0
    assert made.measure.thin == ReconstructOptions().measure.thin


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


@pytest.mark.parametrize(
    ("values", "place"),
    [
        ({"grid": 0}, "grid"),
        ({"grid": math.nan}, "grid"),
        ({"max_length": -0.1}, "max_length"),
        ({"roots": 2.5}, "roots"),
        ({"gird": 1e-3}, "gird"),
        ({"seed": -1}, "seed"),
        ({"measure": {"thin": 0}}, "measure.thin"),
        ({"measure": {"bank": {"wavelength": 1}}}, "measure.bank.wavelength"),
        ({"light_codes": {"search": {"neighbours": 32}}}, "light_codes.search.neighbours"),
        ({"light_codes": {"search": {"steps": 1}}}, "light_codes.search.steps"),
        ({"motion": {"between": "jump"}}, "motion.between"),
    ],
)
def test_a_bad_field_is_named_with_its_place(values: dict[str, object], place: str) -> None:
    with pytest.raises(BadOptions, match=rf"^options\.reconstruct\.{place}: \S"):
        parse_options(ReconstructOptions, values, "options.reconstruct")


def test_options_are_checked_without_what_methods_need() -> None:
    code = (
        "import sys, reconstruction.reconstruct_options;"
        "sys.exit(' '.join({'numpy', 'scipy', 'cv2', 'drjit'} & set(sys.modules)) or 0)"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")
