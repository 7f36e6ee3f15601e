"""One contract for every camera: on the simulators' link, and on pylon's emulation of a Basler."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
import pytest

from reconstruction import Camera as Geometry
from stage_service.device_config import BaslerConfig
from stage_service.devices.cameras.basler import BaslerCamera
from stage_service.devices.cameras.interface import CameraDevice
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.errors import Cancelled, DeviceError

NEVER = threading.Event()
WIDTH, HEIGHT = 16, 12


@dataclass
class Rig:
    """A camera that is not connected yet, and what fires it."""

    camera: CameraDevice
    fire: Callable[[], object]


@pytest.fixture
def link(simulated) -> Iterator[Rig]:
    rig_file, world = simulated()
    camera = DeviceSet.of(rig_file).cameras[0]
    yield Rig(camera, world.pulse)
    camera.close()


@pytest.fixture
def basler(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    if find_spec("pypylon") is None:
        pytest.skip("pypylon is missing: pip install 'hairstage[basler]'")
    monkeypatch.setenv("PYLON_CAMEMU", "2")
    config = BaslerConfig.model_validate(
        {
            "kind": "basler",
            "serials": {"cam_a": "0815-0000"},
            "gain": 1000.0,
            "features": {"Width": WIDTH, "Height": HEIGHT},
            "frame_s": 0.1,
        }
    )
    k = np.array([[40.0, 0, WIDTH / 2], [0, 40.0, HEIGHT / 2], [0, 0, 1]])
    camera = BaslerCamera(config, Geometry("cam_a", WIDTH, HEIGHT, k, np.eye(3), np.zeros(3)))

    def fire() -> None:
        from pypylon import pylon

        device = camera._camera
        if device.IsGrabbing():
            device.WaitForFrameTriggerReady(2000, pylon.TimeoutHandling_Return)
        device.GetNodeMap().GetNode("TriggerSoftware").Execute()

    yield Rig(camera, fire)
    camera.close()


@pytest.fixture(params=["link", "basler"])
def rig(request: pytest.FixtureRequest) -> Rig:
    one: Rig = request.getfixturevalue(request.param)
    one.camera.connect()
    return one


def test_an_armed_camera_sends_a_frame_per_pulse(rig):
    rig.camera.arm(0.002)
    frames = []
    for _ in range(4):
        rig.fire()
        frames.append(rig.camera.read(NEVER))
    assert [f.block_id for f in frames] == [1, 2, 3, 4]
    for frame in frames:
        assert frame.counts.shape == (HEIGHT, WIDTH, 3)
        assert frame.counts.dtype == np.uint16
        assert frame.counts.max() <= rig.camera.info.full_scale
        assert frame.exposure == pytest.approx(0.002, rel=0.01)
        assert frame.left == 0
    if rig.camera.capabilities.timestamps:
        assert sorted({f.timestamp for f in frames}) == [f.timestamp for f in frames]
    assert rig.camera.read(NEVER) is None


def test_frames_wait_until_they_are_read(rig):
    rig.camera.arm(0.002)
    for _ in range(3):
        rig.fire()
    assert [rig.camera.read(NEVER).block_id for _ in range(3)] == [1, 2, 3]


def test_arming_drops_what_was_not_read_and_the_numbers_go_on(rig):
    rig.camera.arm(0.002)
    rig.fire()
    assert rig.camera.read(NEVER).block_id == 1
    rig.fire()
    rig.camera.arm(0.004)
    assert rig.camera.read(NEVER) is None
    rig.fire()
    frame = rig.camera.read(NEVER)
    # A camera that was armed again before it exposed makes no frame of that pulse, and no number.
    assert frame.block_id in (2, 3)
    assert frame.exposure == pytest.approx(0.004, rel=0.01)


def test_a_disarmed_camera_sends_no_frame(rig):
    rig.camera.arm(0.002)
    rig.camera.disarm()
    rig.fire()
    assert rig.camera.read(NEVER) is None


def test_a_read_can_be_cancelled_or_finds_nothing(rig):
    rig.camera.arm(0.002)
    cancel = threading.Event()
    cancel.set()
    with suppress(Cancelled):
        assert rig.camera.read(cancel) is None


def test_closed_it_can_be_connected_again(rig):
    rig.camera.close()
    rig.camera.connect()
    rig.camera.arm(0.002)
    rig.fire()
    assert rig.camera.read(NEVER).block_id == 1


def test_a_closed_camera_reports_that_it_is_closed(rig):
    rig.camera.close()
    with pytest.raises(DeviceError, match="cam_a"):
        rig.camera.arm(0.002)
