"""Faults of DSLRs, on libgphoto2's virtual camera and on the stand-in library (tests/dslrs.py)."""

from __future__ import annotations

import sys
import threading
import time

import numpy as np
import pytest
from dng_writer import write_dng
from dslrs import Body, FakeGphoto2, Setting, dslr, jpeg
from waiting import until

from stage_service.acquisition.accounting import FrameAccount
from stage_service.devices.cameras import gphoto2_settings
from stage_service.devices.cameras.gphoto2_settings import seconds
from stage_service.devices.cameras.photographs import BLACK, FULL
from stage_service.devices.errors import (
    Cancelled,
    DeviceError,
    DeviceTimeout,
    DeviceUnreachable,
    IndexShift,
)

NEVER = threading.Event()


def shoot(camera, exposure=0.002):
    camera.connect()
    camera.arm(exposure)
    camera.release()
    return camera.read(NEVER)


def srgb(code):
    """Linear light of a grey level (IEC 61966-2-1)."""
    return ((code / 255 + 0.055) / 1.055) ** 2.4


def test_a_raw_file_of_the_virtual_camera_becomes_linear_counts(virtual_nikon, tmp_path):
    rggb = np.array([[1000, 20000], [20000, 65535]], np.uint16)
    write_dng(tmp_path / "raw.dng", np.tile(rggb, (24, 32)))
    camera = virtual_nikon((tmp_path / "raw.dng").read_bytes(), size=(64, 48), jpeg=False)
    frame = shoot(camera, 0.01)
    assert frame.counts.shape == (48, 64, 3)
    inside = frame.counts[2:-2, 2:-2].reshape(-1, 3)
    shares = (np.array([1000, 20000, 65535]) - 64) / (65535 - 64)  # the writer's black and white
    np.testing.assert_allclose(
        inside, np.tile(BLACK + shares * (FULL - BLACK), (len(inside), 1)), atol=1
    )
    radiance = frame.radiance(camera.info)[10, 10]
    np.testing.assert_allclose(radiance * 1000.0 * 0.01 / (FULL - BLACK), shares, atol=1e-4)


def test_a_jpeg_file_is_decoded_by_the_srgb_curve(virtual_nikon):
    camera = virtual_nikon(jpeg(200))
    counts = shoot(camera, 0.01).counts
    np.testing.assert_allclose(counts, BLACK + srgb(200) * (FULL - BLACK), atol=1)


def test_the_virtual_camera_refuses_exposures_that_are_not_in_its_list(virtual_nikon):
    camera = virtual_nikon()
    camera.connect()
    with pytest.raises(
        DeviceError, match=r"nearest is 0\.0025 s, received 0\.003 s\. Set the plan"
    ):
        camera.arm(0.003)
    with pytest.raises(DeviceError, match=r"nearest is 1 s, received 5 s"):
        camera.arm(5.0)
    camera.arm(0.05)
    assert camera._settings.value("shutterspeed") == "0.0500s"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"f-number": "f/3"}, r"f-number to f/3: expected one of f/2\.8, f/3\.5, .* received f/3"),
        (
            {"sharpness": 3},
            r"setting sharpness to 3: expected the setting, received a camera without",
        ),
        ({"imagesize": "1024x768"}, r"imagesize .* received one that cannot\. Turn its mode dial"),
        ({"shutterspeed": "1/60"}, r"does not write itself, received shutterspeed\. Remove"),
    ],
)
def test_the_virtual_camera_refuses_settings_that_it_has_not(virtual_nikon, settings, message):
    with pytest.raises(DeviceError, match=message):
        virtual_nikon(settings=settings).connect()


def test_settings_reach_the_virtual_camera(virtual_nikon):
    camera = virtual_nikon(settings={"f-number": "f/8", "exposurecompensation": -1})
    camera.connect()
    assert camera._settings.value("f-number") == "f/8"
    assert camera._settings.value("exposurecompensation") == "-1"
    assert camera._settings.value("autofocus") == "Off"


def test_the_virtual_camera_reports_that_its_card_is_full(virtual_nikon):
    """It has room for 26 images, then reports StoreFull (PTP event 0x400A)."""
    camera = virtual_nikon()
    camera.connect()
    camera.arm(0.005)
    for n in range(26):
        camera.release()
        assert camera.read(NEVER).block_id == n + 1
    camera.release()
    with pytest.raises(DeviceError, match=r"received a full card .*battery 50%.* Empty the card"):
        camera.read(NEVER)


def test_a_photograph_that_no_release_made_is_an_index_shift(virtual_nikon):
    camera = virtual_nikon()
    camera.connect()
    camera.arm(0.005)
    camera.release()
    camera._settings.write("opcode", "0x9999,0x0,0xc8")  # 0.2 s later it takes one by itself
    account = FrameAccount("cam_a", camera.capabilities.block_wrap)
    account.arrived(camera.read(NEVER).block_id)
    until(lambda: camera._files or camera._look())
    with pytest.raises(IndexShift, match="no frame beside those of our pulses"):
        account.late(camera.read(NEVER).block_id)


def test_a_jpeg_file_of_the_virtual_camera_in_place_of_raw_is_refused(virtual_nikon):
    with pytest.raises(DeviceError, match=r"a RAW file, received the JPEG .*image quality to RAW"):
        shoot(virtual_nikon(jpeg=False), 0.005)


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (jpeg(size=(8, 12)), "16x12 pixels as in the rig file, received 8x12 in"),
        (jpeg()[:40], r"a photograph, received .*, 40 bytes: a damaged JPEG file\. Set the camera"),
        (b"text, no photograph", r"a photograph, received .*, 19 bytes: Input/output error"),
    ],
)
def test_files_of_the_virtual_camera_that_do_not_fit_are_refused(virtual_nikon, picture, message):
    with pytest.raises(DeviceError, match=message):
        shoot(virtual_nikon(picture), 0.005)


def test_another_serial_number_lists_the_cameras_that_are_there(virtual_nikon):
    camera = virtual_nikon(serials={"cam_a": "3041"})
    message = r"serial number or port 3041, received Nikon DSC D750 0\.1 at usb:001,001\. Check"
    with pytest.raises(DeviceUnreachable, match=message):
        camera.connect()
    by_port = virtual_nikon(serials={"cam_a": "usb:001,001"})
    assert shoot(by_port, 0.005).block_id == 1


def test_two_cameras_of_one_model_are_found_by_number_or_port_and_opened_once(stand_in):
    bodies = [
        Body(serial=str(n), port=f"usb:001,00{n}", picture=lambda n=n: jpeg(40 * n))
        for n in (1, 2, 3)
    ]
    first = stand_in(*bodies)
    second, third = dslr("2"), dslr("usb:001,003")
    frames = [shoot(camera) for camera in (first, second, third)]
    codes = [round(255 * f.counts.mean() / FULL) for f in frames]
    assert codes == sorted(set(codes))
    assert [len(b.opened) for b in bodies] == [1, 1, 1]
    for camera in (second, third):
        camera.close()


def test_no_camera_and_a_camera_that_another_program_holds(stand_in):
    body = Body(faults={"claimed"})
    camera = stand_in(body)
    with pytest.raises(DeviceUnreachable, match=r"does not open: .*Could not claim.*gvfs"):
        camera.connect()
    body.faults = {"unplugged"}
    with pytest.raises(DeviceUnreachable, match="received no camera at all"):
        camera.connect()


def test_a_model_without_remote_capture_and_an_empty_battery_are_refused(stand_in):
    body = Body(faults={"no capture"})
    camera = stand_in(body)
    with pytest.raises(DeviceError, match="released and set over USB, received Stand-in EOS"):
        camera.connect()
    body.faults = set()
    for charge in ("5%", "Low"):
        body.settings["batterylevel"].value = charge
        with pytest.raises(DeviceError, match=f"at least 10 %, received {charge}. Charge"):
            camera.connect()
    body.settings["batterylevel"].value = "Unknown"
    camera.connect()


@pytest.mark.parametrize("moment", ["release", "read", "arm"])
def test_unplugged_while_armed_and_plugged_in_again(stand_in, moment):
    body = Body(store_s=60.0 if moment == "read" else 0.0)
    camera = stand_in(body)
    camera.connect()
    camera.arm(0.002)
    if moment == "read":
        camera.release()
        until(lambda: body.shots)
    body.faults = {"unplugged"}
    if moment == "release":
        camera.release()
    again = (lambda: camera.arm(0.004)) if moment == "arm" else (lambda: camera.read(NEVER))
    with pytest.raises(DeviceUnreachable, match=r"unplugged, lost power or fell asleep\. Check"):
        again()
    body.faults, body.store_s = set(), 0.0
    assert shoot(camera).block_id == 1


def test_a_busy_camera_makes_no_frame_and_is_waited_for_when_armed(stand_in):
    body = Body()
    camera = stand_in(body, timeout_s=0.2)
    camera.connect()
    camera.arm(0.002)
    body.busy = 2
    camera.release()
    assert camera.read(NEVER) is None
    camera.arm(0.002)
    assert body.busy == 0
    camera.release()
    assert camera.read(NEVER).block_id == 1
    body.busy = 10**6
    with pytest.raises(DeviceTimeout, match=r"is ready within 0\.2 s, received busy all the time"):
        camera.arm(0.002)


def test_a_release_without_a_file_is_reported(stand_in):
    body = Body(faults={"no file"})
    with pytest.raises(DeviceTimeout, match=r"none \(battery 75%, room for 150.*mirror lock-up"):
        shoot(stand_in(body, frame_s=0.1))
    with pytest.raises(DeviceError, match=r"a full card \(battery 75%, room for 0 images\)"):
        shoot(stand_in(Body(faults={"full"})))


def test_waiting_for_a_file_can_be_cancelled(stand_in):
    camera = stand_in(Body(store_s=60.0))
    camera.connect()
    camera.arm(0.002)
    camera.release()
    cancel = threading.Event()
    cancel.set()
    with pytest.raises(Cancelled):
        camera.read(cancel)


def test_a_release_that_outlasts_the_light_is_refused(stand_in):
    body = Body(lag_s=0.3, blocks=True)
    with pytest.raises(DeviceTimeout, match=r"within 0\.102 s, .*off by then: raise release_s"):
        shoot(stand_in(body, release_s=0.1))
    assert shoot(stand_in(body, release_s=30.0)).block_id == 1


def test_a_release_that_hangs_delays_closing_by_its_deadline_alone(stand_in, slack):
    body = Body(lag_s=0.5 * slack, blocks=True)
    camera = stand_in(body, timeout_s=0.1)
    camera.connect()
    camera.arm(0.002)
    release = threading.Thread(target=camera.release)
    release.start()
    until(lambda: body.releases)
    began = time.monotonic()
    camera.close()
    with pytest.raises(DeviceTimeout, match=r"within 0\.1 s, received a camera that hangs"):
        camera.connect()
    assert time.monotonic() - began < 0.4 * slack
    release.join()
    body.lag_s = 0.0
    assert shoot(camera).block_id == 1


def test_two_files_a_frame_and_a_wrong_mode_dial_are_refused(stand_in):
    body = Body()
    camera = stand_in(body, settings={"imageformat": "RAW + L"})
    camera.connect()
    with pytest.raises(DeviceError, match=r"one file a frame, received imageformat = RAW \+ L"):
        camera.arm(0.002)
    body.settings["imageformat"].value = "RAW"
    body.settings["shutterspeed"].readonly = True
    with pytest.raises(DeviceError, match="Turn its mode dial to M"):
        camera.arm(0.002)
    body.settings["shutterspeed"] = Setting("auto", ["auto"])
    with pytest.raises(DeviceError, match=r"a list of shutter speeds.*mode dial to M"):
        camera.arm(0.002)


def test_bulb_opens_and_closes_the_shutter(stand_in, monkeypatch, slack):
    monkeypatch.setattr(gphoto2_settings, "BULB_S", 0.1)
    body = Body()
    camera = stand_in(body)
    frame = shoot(camera, 0.15)
    ((opened, closed),) = body.opened
    assert body.settings["shutterspeed"].value == "bulb"
    assert closed - opened == pytest.approx(0.15, abs=0.03 * slack)
    assert frame.exposure == pytest.approx(closed - opened, abs=0.03 * slack)
    with pytest.raises(DeviceError, match=r"nearest is 0\.0166667 s, received 0\.09 s"):
        camera.arm(0.09)


def test_files_are_deleted_once_read_unless_they_are_kept(stand_in):
    for keep in (False, True):
        body = Body()
        camera = stand_in(body, keep=keep)
        assert shoot(camera).block_id == 1
        assert (len(body.files) == 1) is keep
    assert body.settings["capturetarget"].value == "Internal RAM"


def test_shutter_speeds_of_all_makers_are_read():
    speeds = {"1/125": 0.008, "0.0080s": 0.008, "1.3": 1.3, "10/25": 0.4, "30.0000s": 30.0}
    assert {s: seconds(s) for s in speeds} == pytest.approx(speeds)
    assert [seconds(s) for s in ("bulb", "Time", "auto", "0", "1/0", "")] == [None] * 6


def test_without_the_library_the_error_names_the_install_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "gphoto2", None)
    with pytest.raises(DeviceUnreachable, match=r"pip install 'hairstage\[gphoto2\]'"):
        dslr("1").connect()


def test_the_stand_in_has_the_names_of_the_library():
    """What the driver finds in the stand-in is in the library, with the same numbers."""
    gphoto2 = pytest.importorskip("gphoto2", reason="python-gphoto2 is missing")
    constants = [n for n in vars(FakeGphoto2) if n.startswith("GP_")]
    assert {n: getattr(FakeGphoto2, n) for n in constants} == {
        n: getattr(gphoto2, n) for n in constants
    }
    calls = "autodetect set_port_info init exit get_abilities get_storageinfo get_single_config"
    calls += " set_single_config trigger_capture wait_for_event file_get file_delete"
    assert [n for n in calls.split() if not hasattr(gphoto2.Camera, n)] == []
