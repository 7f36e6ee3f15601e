"""The Basler driver on pylon's own camera emulation, shown what the simulated sensor makes."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydantic import ValidationError
from waiting import until

from reconstruction import Camera as CameraGeometry
from simulators.frames.frames import Sensor
from stage_service.acquisition.accounting import FrameAccount
from stage_service.device_config import BaslerConfig
from stage_service.devices.cameras.basler import BaslerCamera
from stage_service.devices.cameras.genicam import BlockCounter
from stage_service.devices.errors import DeviceError, DeviceUnreachable, IndexShift

WIDTH, HEIGHT = 32, 24
SENSOR = Sensor()
EXPOSURE = 0.002
NEVER = threading.Event()
SITES = {"RG": "RGGB", "GR": "GRBG", "GB": "GBRG", "BG": "BGGR"}
Make = Callable[..., BaslerCamera]


@pytest.fixture(scope="module", autouse=True)
def emulation() -> Iterator[None]:
    """Two emulated cameras: the variable is read when pylon first looks for cameras."""
    if find_spec("pypylon") is None:
        pytest.skip("pypylon is missing: pip install 'hairstage[basler]'")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYLON_CAMEMU", "2")
        yield


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[np.ndarray]]:
    """A folder of images that the emulation shows in turn, and their counts `(H, W, 3)`.

    The simulated sensor's answer to hair-like strips of light, 12 bits in the upper bits of 16.
    """
    folder = tmp_path_factory.mktemp("shots")
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    frames = []
    for i in range(3):
        strips = 1.5 + np.sin(0.2 * x + 0.1 * y + i)
        radiance = strips[..., None] * np.array([0.7, 0.4, 0.2]) * 4.0
        frames.append(SENSOR.expose(radiance, EXPOSURE, (i,)))
        assert cv2.imwrite(str(folder / f"{i}.png"), frames[i][..., ::-1] * 16 + 8)
    return folder, frames


@pytest.fixture
def make(shots: tuple[Path, list[np.ndarray]]) -> Iterator[Make]:
    """Makes cameras that show `shots`; closes them."""
    made: list[BaslerCamera] = []

    def one(**fields: object) -> BaslerCamera:
        table = {
            "kind": "basler",
            "serials": {"left": "0815-0000", "right": "0815-0001"},
            "gain": SENSOR.gain,
            "black": SENSOR.black,
            "features": {
                "Width": WIDTH,
                "Height": HEIGHT,
                "TestImageSelector": "Off",
                "ImageFilename": str(shots[0]),
                "ImageFileMode": "On",
            },
            "frame_s": 0.5,
        }
        name = fields.pop("name", "left")
        config = BaslerConfig.model_validate(table | fields)
        k = np.array([[40.0, 0, WIDTH / 2], [0, 40.0, HEIGHT / 2], [0, 0, 1]])
        geometry = CameraGeometry(str(name), WIDTH, HEIGHT, k, np.eye(3), np.zeros(3))
        made.append(BaslerCamera(config, geometry))
        return made[-1]

    yield one
    for camera in made:
        camera.close()


@pytest.fixture
def camera(make: Make) -> BaslerCamera:
    """A connected camera."""
    one = make()
    one.connect()
    return one


def execute(camera: BaslerCamera, command: str) -> None:
    camera._camera.GetNodeMap().GetNode(command).Execute()


def pulse(camera: BaslerCamera) -> None:
    """A pulse that the camera is ready for: the emulation has no lines, but takes this in their
    stead whatever the source."""
    from pypylon import pylon

    assert camera._camera.WaitForFrameTriggerReady(2000, pylon.TimeoutHandling_Return)
    execute(camera, "TriggerSoftware")


def node(camera: BaslerCamera, name: str) -> str:
    return camera._camera.GetNodeMap().GetNode(name).ToString()


def test_the_camera_waits_for_pulses_on_its_line(make):
    camera = make(trigger_line="Line2")
    camera.connect()
    camera.arm(EXPOSURE)
    written = {
        "TriggerSelector": "FrameStart",
        "TriggerMode": "On",
        "TriggerSource": "Line2",
        "TriggerActivation": "RisingEdge",
        "TriggerDelay": "0.0",
        "LineSelector": "Line2",
        "LineMode": "Input",
        "ExposureMode": "Timed",
        "ExposureAuto": "Off",
        "ExposureTime": "2000.0",
        "AcquisitionMode": "Continuous",
        "AcquisitionFrameRateEnable": "0",
        "ChunkModeActive": "0",  # the emulation has no chunks to choose from
        "PixelFormat": "BayerRG12",
    }
    assert {name: node(camera, name) for name in written} == written
    assert camera._camera.MaxNumBuffer.Value == camera.capabilities.buffers == 16
    assert not camera.capabilities.timestamps  # nor has it a clock


def test_frames_are_the_simulated_sensor_s_counts(make, shots):
    camera = make(pixel_format="BayerRG12")
    camera.connect()
    camera.arm(EXPOSURE)
    shown = set()
    for _ in range(2 * len(shots[1])):  # the emulation shows each image twice in a row
        pulse(camera)
        frame = camera.read(NEVER)
        assert (frame.counts.shape, frame.counts.dtype) == ((HEIGHT, WIDTH, 3), np.uint16)
        assert (frame.exposure, frame.timestamp) == (EXPOSURE, 0.0)
        shown.add(assert_mosaic(frame.counts, shots[1], "RG"))
    assert shown == {0, 1, 2}
    assert (camera.info.width, camera.info.height, camera.info.full_scale) == (WIDTH, HEIGHT, 4095)
    radiance = frame.radiance(camera.info)
    assert frame.full_scale(camera.info) > radiance.max() > 4.0


def assert_mosaic(rgb: np.ndarray, shots: list[np.ndarray], order: str) -> int:
    """Each pixel has its own colour's count, near it in the others; returns which shot."""
    shot = int(np.argmin([np.abs(rgb - s.astype(float)).mean() for s in shots]))
    counts = shots[shot]
    for k, colour in enumerate(SITES[order]):
        y, x, c = k // 2, k % 2, "RGB".index(colour)
        # Within the emulation's own rounding, and but for the border, which copies its neighbour.
        inside = (slice(2 + y, -2, 2), slice(2 + x, -2, 2), c)
        np.testing.assert_allclose(rgb[inside].astype(int), counts[inside], atol=1)
    inner = (slice(2, -2), slice(2, -2))
    np.testing.assert_allclose(rgb[inner].mean((0, 1)), counts[inner].mean((0, 1)), rtol=0.02)
    return shot


@pytest.mark.parametrize("order", sorted(SITES))
def test_every_bayer_order_is_recognised(make, shots, order):
    camera = make(pixel_format=f"Bayer{order}12")
    camera.connect()
    camera.arm(EXPOSURE)
    pulse(camera)
    assert_mosaic(camera.read(NEVER).counts, shots[1], order)


@pytest.mark.parametrize(("pixel_format", "full_scale"), [("Mono8", 255), ("Mono16", 65535)])
def test_mono_stands_in_every_channel(make, pixel_format, full_scale):
    camera = make(pixel_format=pixel_format)
    camera.connect()
    camera.arm(EXPOSURE)
    pulse(camera)
    counts = camera.read(NEVER).counts
    assert counts.shape == (HEIGHT, WIDTH, 3)
    assert np.ptp(counts, axis=2).max() == 0
    assert camera.info.full_scale == full_scale > counts.max() > full_scale // 8


def test_an_overtrigger_leaves_no_gap(camera):
    account = FrameAccount(camera.name, camera.capabilities.block_wrap)
    camera.arm(EXPOSURE)
    pulse(camera)
    for _ in range(20):  # while it exposes
        execute(camera, "TriggerSoftware")
    first = camera.read(NEVER)
    assert camera.read(NEVER) is None
    pulse(camera)
    ids = [first.block_id, camera.read(NEVER).block_id]
    assert ids == [1, 2]
    for block_id in ids:
        account.arrived(block_id)


def test_an_unexpected_frame_is_detected_without_a_clock(camera):
    account = FrameAccount(camera.name, camera.capabilities.block_wrap)
    camera.arm(EXPOSURE)
    for _ in range(3):
        pulse(camera)
    until(lambda: camera._camera.NumReadyBuffers.Value == 3)
    first = camera.read(NEVER)
    assert first.left == 2
    with pytest.raises(IndexShift, match="2 behind block id 1"):
        account.arrived(first.block_id, first.left)
    assert [camera.read(NEVER).left for _ in range(2)] == [1, 0]


def test_a_damaged_frame_is_a_lost_frame(camera):
    account = FrameAccount(camera.name, camera.capabilities.block_wrap)
    camera._camera.GetNodeMap().GetNode("ForceFailedBufferCount").SetValue(1)
    camera.arm(EXPOSURE)
    execute(camera, "ForceFailedBuffer")
    pulse(camera)
    assert camera.read(NEVER) is None
    account.missed()
    pulse(camera)
    frame = camera.read(NEVER)
    account.arrived(frame.block_id)
    assert frame.block_id == 2


def test_two_cameras_are_identified_by_serial_number(camera, make):
    other = make(name="right")
    other.connect()
    for one in (camera, other):
        one.arm(EXPOSURE)
    pulse(other)
    assert other.read(NEVER).block_id == 1
    assert camera.read(NEVER) is None


def features(**changed: object) -> dict[str, object]:
    return {"features": {"Width": WIDTH, "Height": HEIGHT} | changed}


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (features(Width=64), "expected 32x24 pixels as in the rig file, received 64x24"),
        (features(Width=99999), "setting Width to 99999: expected 1 to 4096, received 99999"),
        (features(Sharpness=1), "setting Sharpness to 1: expected Sharpness = 1, received no such"),
        (features(TriggerMode="Off"), "does not set itself, received TriggerMode"),
        ({"trigger_line": "Line7"}, "expected one of Line1, Line2, Line3, received Line7"),
        ({"serials": {"left": "12345678"}}, "number 12345678, received 0815-0000, 0815-0001"),
        ({"serials": {"middle": "0815-0000"}}, "serials in"),
    ],
)
def test_a_camera_that_mismatches_the_rig_file_is_reported(make, fields, message):
    camera = make(**fields)
    with pytest.raises(DeviceError, match="camera left") as error:
        camera.connect()
    assert message in str(error.value)
    with pytest.raises(DeviceUnreachable, match="expected an open camera"):
        camera.arm(EXPOSURE)


def test_an_unsupported_pixel_format_is_reported(make):
    camera = make()
    camera.connect()
    with pytest.raises(
        DeviceError, match=r"expected one of Mono8, .*BayerBG16, received BayerRG14"
    ):
        camera._nodes().write("PixelFormat", "BayerRG14")


@pytest.mark.parametrize(
    ("exposure", "message"), [(20.0, "expected 1 to 1e"), (1.4e-6, "received 1e-06 s")]
)
def test_an_unsupported_exposure_is_reported(camera, exposure, message):
    with pytest.raises(DeviceError, match=message):
        camera.arm(exposure)
    assert camera.read(NEVER) is None


def test_frames_of_another_size_are_refused(camera):
    camera._camera.GetNodeMap().GetNode("Width").SetValue(16)
    camera.arm(EXPOSURE)
    pulse(camera)
    with pytest.raises(DeviceError, match=r"expected 32x24 .*BayerRG12.*received 16x24"):
        camera.read(NEVER)


def test_without_pypylon_the_error_names_the_install_command(make, monkeypatch):
    monkeypatch.setitem(sys.modules, "pypylon", None)
    with pytest.raises(DeviceUnreachable, match=r"pip install 'hairstage\[basler\]'"):
        make().connect()


def test_two_cameras_cannot_share_a_serial_number(make):
    with pytest.raises(ValidationError, match="two cameras have the same serial number"):
        make(serials={"left": "1", "right": "1"})


def test_block_ids_are_counted_across_wraps_and_restarts():
    gige, usb = BlockCounter(1, 65535), BlockCounter(0, (1 << 63) - 1)
    gige.count, gige._before = 65533, 65533
    assert [gige.take(i) for i in (65534, 65535, 1, 1, 3)] == [65534, 65535, 65536, 65536, 65538]
    assert [gige.take(i) for i in (0, 65536)] == [None, None]
    gige.restart()
    assert gige.take(1) == 65539
    assert [usb.take(i) for i in (0, 1, 3, (1 << 64) - 1)] == [1, 2, 4, None]
    usb.restart()
    assert usb.take(1) == 6  # the first frame after the restart was lost
