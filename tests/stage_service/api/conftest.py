"""A service that shoots, asked over HTTP."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from serving import Client, serving

from stage_service.config import RigFile
from stage_service.device_config import LightRegisters


@pytest.fixture
def http(rig_file: RigFile, tmp_path: Path) -> Iterator[Client]:
    with serving(rig_file, tmp_path / "root") as client:
        yield client


@pytest.fixture
def unread_rig(rig_file: RigFile) -> RigFile:
    """The rig with a light bank that cannot tell whether its lamps are off, which is accepted."""
    assert rig_file.devices is not None
    over = {"registers": LightRegisters(lit=None), "accept_unverified_blackout": True}
    lights = rig_file.devices.lights.model_copy(update=over)
    return replace(rig_file, devices=rig_file.devices.model_copy(update={"lights": lights}))
