"""The floors' own small subjects and stages, for the benchmarks' tests as well."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

TESTS = Path(__file__).parents[2]


def fixtures(folder: str) -> ModuleType:
    """The `conftest.py` of another folder of tests."""
    name = f"fixtures_{folder.replace('/', '_')}"
    spec = importlib.util.spec_from_file_location(name, TESTS / folder / "conftest.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look there
    spec.loader.exec_module(module)
    return module


small = fixtures("appearance").small
spheres = fixtures("reconstruction")
shoot, two_cameras = spheres.shoot, spheres.two_cameras
fibres = fixtures("reconstruction/light_codes").fibres
