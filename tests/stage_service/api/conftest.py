"""A service that shoots, asked over HTTP."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from serving import Client, serving

from stage_service.config import RigFile


@pytest.fixture
def http(rig_file: RigFile, tmp_path: Path) -> Iterator[Client]:
    with serving(rig_file, tmp_path / "root") as client:
        yield client
