"""A capture written out as photographs comes back through the importer as it was."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.importing.damages import table
from benchmarks.importing.folders import Written, write_folder

from reconstruction import Camera, Capture, Light, import_folder
from reconstruction.arrays import Array
from reconstruction.capture.import_folder import settings_of
from reconstruction.capture.import_geometry import files_in, read_geometry

LIGHTS = [Light(f"light_{i}", np.array([0.3 * i, -1.0, 0.4]), np.ones(3)) for i in range(2)]


def ramp(step: dict[str, object], device: Camera) -> Array:
    """A disc that is brighter to one side, as each light tells another one."""
    y, x = np.mgrid[: device.height, : device.width] / device.width - 0.5
    inside = np.hypot(x, y) < 0.4
    return np.where(inside, 0.5 + (0.4 if step["light"] == "light_0" else -0.4) * x, 0.0)


@pytest.mark.parametrize("kind", ["exr", "png16", "png8", "bayer"])
def test_frames_and_rig_survive_the_way_out_and_in(
    shoot: Callable[..., Capture], tmp_path: Path, kind: str
) -> None:
    capture = shoot(lights=LIGHTS, sweep=False, extra=ramp)
    folder = write_folder(capture, tmp_path / "folder", Written(kind, head=False, sweep=False))
    settings = settings_of(folder)
    geometry = read_geometry(files_in(folder, settings.geometry))
    found = import_folder(folder, tmp_path / "out", geometry=geometry, settings=settings)
    names = [c.name for c in capture.rig.cameras]
    assert [c.name for c in found.rig.cameras] == names
    scale = []
    for a, b in zip(capture.rig.cameras, found.rig.cameras, strict=True):
        np.testing.assert_allclose(b.center, a.center, atol=1e-5)
        for light in LIGHTS:
            true, read = (c.light(light.name, a.name)[0].mean(axis=-1) for c in (capture, found))
            scale.append(float((true * read).sum() / (read**2).sum()))
            error = np.abs(scale[-1] * read - true).max() / true.max()
            assert error < {"exr": 1e-6, "png16": 1e-4, "png8": 7e-3, "bayer": 0.5}[kind]
    np.testing.assert_allclose(scale, scale[0], rtol=1e-2)


def test_what_is_lost_stands_beside_the_direct_capture() -> None:
    def row(fine: float) -> dict[str, Any]:
        pictures = {"ours": {"psnr": 19.0}, "three_nearest": {"psnr": 17.0}}
        return {"visible": {"1mm_10deg": fine, "2mm_20deg": 60.0}, "pictures": pictures}

    text = table({"rows": {"direct": row(20.0), "16-bit PNG": row(17.5)}})
    assert "| 16-bit PNG | 17.5 | 60.0 | -2.5 | 19.0 | 17.0 |" in text
