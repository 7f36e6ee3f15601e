"""One contract per device interface, run against every peer: the tests' own and the simulators'."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from waiting import until

from stage_service.acquisition.safety import blackout
from stage_service.config import RigFile, load_rig_file
from stage_service.devices.device_set import DeviceSet

pytestmark = pytest.mark.usefixtures("permitted")
CHECKOUT = Path(__file__).resolve().parents[3]
NEVER = threading.Event()
RIG = """
name = "small"
[dome]
lights = 200
radius = 1.2
intensity = [8.0, 8.0, 8.0]
[[cameras]]
name = "cam_0"
position = [0.0, -0.95, 0.12]
target = [0.0, 0.0, 0.0]
fov_deg = 22.0
width = 16
height = 12
[[projectors]]
name = "left"
position = [0.0, 1.0, 0.3]
target = [0.0, 0.0, 0.0]
fov_deg = 17.0
width = 12
height = 12
[devices.lights]
port = 15020
timeout_s = 30.0
[devices.trigger]
port = "trigger"
timeout_s = 30.0
[devices.projectors]
port = "projectors"
timeout_s = 30.0
[devices.cameras]
port = 15021
timeout_s = 30.0
"""


@pytest.fixture(scope="module")
def simulators(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RigFile]:
    """`python -m simulators` for a small rig, in a process of its own."""
    folder = tmp_path_factory.mktemp("simulators")
    (folder / "rig.toml").write_text(RIG)
    command = [sys.executable, "-m", "simulators", "--rig", folder / "rig.toml"]
    with (folder / "log").open("w") as log:
        process = subprocess.Popen(
            [*command, "--state", folder, "--ports", "auto", "--spp", "1"],
            cwd=CHECKOUT,
            stdout=log,
            stderr=log,
            env=os.environ,
        )
    devices = folder / "devices.toml"
    until(lambda: devices.exists() or process.poll() is not None)
    assert devices.exists(), (folder / "log").read_text()
    yield load_rig_file(folder / "rig.toml", devices)
    process.terminate()
    process.wait(60)


@pytest.fixture(params=["the tests' peers", "simulators"])
def stage(request: pytest.FixtureRequest) -> Iterator[DeviceSet]:
    own = request.param != "simulators"
    rig_file: Any = request.getfixturevalue("rig_file" if own else "simulators")
    one = DeviceSet.of(rig_file)
    one.connect()
    yield one
    blackout(one)
    one.close()


def test_camera(stage):
    camera, trigger = stage.cameras[0], stage.trigger
    stage.lights.off()
    assert camera.read(NEVER) is None
    trigger.pulse(0.001)
    assert camera.read(NEVER) is None  # not armed
    camera.arm(0.001)
    trigger.pulse(0.001)
    trigger.pulse(0.001)
    frames = [camera.read(NEVER) for _ in range(2)]
    assert [f.block_id for f in frames] == [1, 2]
    for frame in frames:
        assert frame.counts.shape == (camera.info.height, camera.info.width, 3)
        assert frame.exposure == 0.001
        # No lamp was on: black level and its noise, nothing else.
        np.testing.assert_allclose(frame.counts.mean(), camera.info.black, atol=1.0)
    assert camera.read(NEVER) is None
    trigger.pulse(0.001)
    camera.arm(0.002)  # empties the queue
    assert camera.read(NEVER) is None
    trigger.pulse(0.002)
    frame = camera.read(NEVER)
    assert (frame.block_id, frame.exposure) == (4, 0.002)
    camera.disarm()
    trigger.pulse(0.001)
    assert camera.read(NEVER) is None


def test_blackout_is_read_back(stage):
    stage.lights.set_watchdog(60.0)
    stage.lights.all_on()
    stage.projectors.all_on(1.0)
    assert blackout(stage).safe
    assert stage.lights.status().lit == 0
    assert stage.projectors.is_dark()
