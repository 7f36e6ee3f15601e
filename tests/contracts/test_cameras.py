"""One contract for every camera: on the simulators' link, and on other makers' own emulations."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
import pytest
from waiting import until

from reconstruction import Camera as Geometry
from stage_service.device_config import AravisConfig, BaslerConfig
from stage_service.devices.cameras.aravis import AravisCamera
from stage_service.devices.cameras.basler import BaslerCamera
from stage_service.devices.cameras.gphoto2 import Gphoto2Camera
from stage_service.devices.cameras.interface import CameraDevice
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.errors import Cancelled, DeviceError, DeviceTimeout, DeviceUnreachable

NEVER = threading.Event()
WIDTH, HEIGHT = 16, 12


@dataclass
class Rig:
    """A camera that is not connected yet, what fires it, and two exposures that it can make."""

    camera: CameraDevice
    fire: Callable[[], object]
    exposures: tuple[float, float] = (0.002, 0.004)


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


class FakeCamera:
    """Aravis' own GigE Vision camera, a program at the loopback address; its frames are 16 bits."""

    def __init__(self, stack: ExitStack, *options: str) -> None:
        program = shutil.which("arv-fake-gv-camera-0.8")
        if program is None or find_spec("gi") is None:
            packages = "aravis-tools gir1.2-aravis-0.8"
            pytest.skip(
                f"Aravis is missing: apt install {packages}, pip install 'hairstage[aravis]'"
            )
        # The protocol's port is fixed: one at a time on this machine.
        lock = os.open(f"{tempfile.gettempdir()}/fake-gv-camera", os.O_CREAT | os.O_WRONLY)
        stack.callback(os.close, lock)
        fcntl.flock(lock, fcntl.LOCK_EX)
        serial = f"HS{os.getpid()}"
        self.process = subprocess.Popen([program, "-i", "127.0.0.1", "-s", serial, *options])
        stack.callback(self.process.wait)
        stack.callback(self.process.kill)
        config = AravisConfig.model_validate(
            {
                "kind": "aravis",
                "serials": {"cam_a": serial},
                "gain": 1000.0,
                "pixel_format": "Mono16",
                "trigger_line": "Line0",
                "features": {"Width": WIDTH, "Height": HEIGHT},
                "frame_s": 0.3,
            }
        )
        k = np.array([[40.0, 0, WIDTH / 2], [0, 40.0, HEIGHT / 2], [0, 0, 1]])
        geometry = Geometry("cam_a", WIDTH, HEIGHT, k, np.eye(3), np.zeros(3))
        self.camera = AravisCamera(config, geometry)
        stack.callback(self.camera.close)
        self.camera._load()
        until(lambda: serial in self.camera._serials())

    def fire(self) -> None:
        """A pulse: the fake has no lines, but a software trigger, which it takes one at a time."""
        nodes, stream = self.camera._nodes(), self.camera._stream
        before = stream.get_n_buffers().n_output_buffers
        nodes.write("TriggerSource", "Software")
        nodes.execute_if_there("TriggerSoftware")
        if self.camera._exposure is not None:
            until(lambda: stream.get_n_buffers().n_output_buffers > before)


@pytest.fixture
def fake_camera() -> Iterator[FakeCamera]:
    with ExitStack() as stack:
        yield FakeCamera(stack)


@pytest.fixture
def aravis(fake_camera: FakeCamera) -> Rig:
    return Rig(fake_camera.camera, fake_camera.fire)


@pytest.fixture
def virtual_dslr(virtual_nikon: Callable[..., Gphoto2Camera]) -> Rig:
    camera = virtual_nikon()
    return Rig(camera, camera.release, (0.005, 0.01))


@pytest.fixture
def stand_in_dslr(stand_in: Callable[..., Gphoto2Camera]) -> Rig:
    camera = stand_in()
    return Rig(camera, camera.release, (0.002, 0.004))


@pytest.fixture(params=["link", "basler", "aravis", "virtual_dslr", "stand_in_dslr"])
def rig(request: pytest.FixtureRequest) -> Rig:
    one: Rig = request.getfixturevalue(request.param)
    one.camera.connect()
    return one


def test_an_armed_camera_sends_a_frame_per_pulse(rig):
    rig.camera.arm(rig.exposures[0])
    frames = []
    for _ in range(4):
        rig.fire()
        frames.append(rig.camera.read(NEVER))
    assert [f.block_id for f in frames] == [1, 2, 3, 4]
    for frame in frames:
        assert frame.counts.shape == (HEIGHT, WIDTH, 3)
        assert frame.counts.dtype == np.uint16
        assert frame.counts.max() <= rig.camera.info.full_scale
        assert frame.exposure == pytest.approx(rig.exposures[0], rel=0.01)
        assert frame.left == 0
    if rig.camera.capabilities.timestamps:
        assert sorted({f.timestamp for f in frames}) == [f.timestamp for f in frames]
    assert rig.camera.read(NEVER) is None


def test_frames_wait_until_they_are_read(rig):
    rig.camera.arm(rig.exposures[0])
    for _ in range(3):
        rig.fire()
    assert [rig.camera.read(NEVER).block_id for _ in range(3)] == [1, 2, 3]


def test_arming_drops_what_was_not_read_and_the_numbers_go_on(rig):
    rig.camera.arm(rig.exposures[0])
    rig.fire()
    assert rig.camera.read(NEVER).block_id == 1
    rig.fire()
    rig.camera.arm(rig.exposures[1])
    assert rig.camera.read(NEVER) is None
    rig.fire()
    frame = rig.camera.read(NEVER)
    # A camera that was armed again before it exposed makes no frame of that pulse, and no number.
    assert frame.block_id in (2, 3)
    assert frame.exposure == pytest.approx(rig.exposures[1], rel=0.01)


def test_a_disarmed_camera_sends_no_frame(rig):
    rig.camera.arm(rig.exposures[0])
    rig.camera.disarm()
    rig.fire()
    assert rig.camera.read(NEVER) is None


def test_a_read_can_be_cancelled_or_finds_nothing(rig):
    rig.camera.arm(rig.exposures[0])
    cancel = threading.Event()
    cancel.set()
    with suppress(Cancelled):
        assert rig.camera.read(cancel) is None


def test_closed_it_can_be_connected_again(rig):
    rig.camera.close()
    rig.camera.connect()
    rig.camera.arm(rig.exposures[0])
    rig.fire()
    assert rig.camera.read(NEVER).block_id == 1


def test_a_closed_camera_reports_that_it_is_closed(rig):
    rig.camera.close()
    with pytest.raises(DeviceError, match="cam_a"):
        rig.camera.arm(rig.exposures[0])


def test_aravis_waits_for_pulses_on_its_line_and_refuses_what_the_camera_has_not(fake_camera):
    camera = fake_camera.camera
    camera.connect()
    camera.arm(0.003)
    nodes = camera._nodes()
    written = {"TriggerMode": "On", "TriggerSource": "Line0", "PixelFormat": "Mono16"}
    assert {name: nodes.text(name) for name in written} == written
    assert nodes.number("ExposureTimeAbs") == 3000
    assert camera.capabilities.timestamps
    with pytest.raises(DeviceError, match=r"PixelFormat to Foo: expected one of .*Mono16.*Foo"):
        nodes.write("PixelFormat", "Foo")
    with pytest.raises(DeviceError, match="expected Nothing = 1, received no such node"):
        nodes.write("Nothing", 1)


def test_an_aravis_camera_that_is_unplugged_or_another_is_reported(fake_camera):
    camera = fake_camera.camera
    camera.connect()
    camera.arm(0.002)
    fake_camera.process.kill()
    until(camera._removed)
    with pytest.raises(DeviceUnreachable, match="unplugged or lost power"):
        camera.read(NEVER)
    with pytest.raises(DeviceUnreachable, match="a camera with serial number HS"):
        camera.connect()


def test_an_aravis_camera_whose_packets_are_lost_is_reported():
    with ExitStack() as stack:
        camera = FakeCamera(stack, "-r", "1000").camera
        with pytest.raises(DeviceTimeout, match=r"a frame within .* Check that no firewall"):
            camera.connect()


def test_without_aravis_the_error_names_the_install_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "gi", None)
    config = AravisConfig(kind="aravis", serials={"cam_a": "1"}, gain=1.0)
    k = np.array([[40.0, 0, WIDTH / 2], [0, 40.0, HEIGHT / 2], [0, 0, 1]])
    camera = AravisCamera(config, Geometry("cam_a", WIDTH, HEIGHT, k, np.eye(3), np.zeros(3)))
    with pytest.raises(DeviceUnreachable, match=r"apt install gir1.2-aravis-0.8, pip install"):
        camera.connect()
