"""Drivers against peers on real wires: what they ask, and how they tell trouble."""

from __future__ import annotations

import contextlib
import json
import math
import os
import pty
import socket
import struct
import threading
import time
import tty
from collections.abc import Iterator

import numpy as np
import pytest
from waiting import until

from stage_service.config import RigFile
from stage_service.device_config import DmxConfig, LinkCamerasConfig, SerialConfig
from stage_service.devices.cameras.fan_out import FanOut
from stage_service.devices.cameras.link import LinkCamera
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.errors import (
    DeviceError,
    DeviceTimeout,
    DeviceUnreachable,
)
from stage_service.devices.heartbeat import Heartbeat
from stage_service.devices.lights.dmx_enttec import DmxLightBank
from stage_service.devices.projectors.serial_controller import SerialProjectorController
from stage_service.devices.trigger.serial_box import SerialTriggerBox

pytestmark = pytest.mark.usefixtures("permitted")
NEVER = threading.Event()


@pytest.fixture
def stage(rig_file: RigFile) -> Iterator[DeviceSet]:
    one = DeviceSet.of(rig_file)
    one.connect()
    yield one
    one.close()


def test_heartbeats_come_while_it_runs_and_trouble_is_kept(stage, world, monkeypatch):
    with Heartbeat(stage.lights, 0.01) as heartbeat:
        until(lambda: world.heartbeats >= 5)
        heartbeat.check()

        def unreachable() -> None:
            raise DeviceUnreachable("bank", "beating", expected="a", received="b", todo="c")

        monkeypatch.setattr(stage.lights, "heartbeat", unreachable)
        until(lambda: heartbeat.error is not None)
        with pytest.raises(DeviceUnreachable, match="beating"):
            heartbeat.check()
        monkeypatch.undo()
        until(lambda: heartbeat.error is None)
    observed = world.heartbeats
    assert threading.Event().wait(0.05) is False
    assert world.heartbeats == observed


def test_serial_ports_that_are_not_there_or_another_device(rig_file, world):
    assert rig_file.devices is not None
    config = SerialConfig(port="/dev/hairstage-nowhere", timeout_s=0.2)
    with pytest.raises(DeviceUnreachable, match="opening the serial port"):
        SerialTriggerBox(config).connect()
    assert rig_file.devices.projectors is not None
    box = SerialTriggerBox(rig_file.devices.projectors)
    with pytest.raises(DeviceError, match=r"'HAIRSTAGE-PROJECTORS left,right'.*check the ports"):
        box.connect()
    box.close()
    controller = SerialProjectorController(rig_file.devices.projectors, ("left", "middle"))
    with pytest.raises(DeviceError, match="expected the projectors left, middle"):
        controller.connect()
    controller.close()


@pytest.mark.parametrize("late", [["ID?"], ["?", "ID?"]])
def test_an_identity_that_comes_late_does_not_shift_the_replies(rig_file, world, slack, late):
    assert rig_file.devices is not None
    world.late, world.pulses = [*late], 7
    port = rig_file.devices.trigger.port
    box = SerialTriggerBox(SerialConfig(port=port, timeout_s=0.2 * slack))
    with pytest.raises(DeviceError, match="identifying: expected a"):
        box.connect()
    box.connect()  # reads the first identity, then the replies to this connection's requests
    assert box.count() == 7
    world.pulses, world.estop = 8, True
    assert box.count() == 8
    assert box.status().estop_pressed
    with pytest.raises(DeviceError, match="ERR 1 unknown command"):
        box._lines.request("NOTHING", "OK", "sending an unknown command")
    box.close()


def test_a_device_that_talks_on_and_on_is_given_up_at_its_deadline():
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    over = threading.Event()

    def talk() -> None:
        with contextlib.suppress(OSError):
            while not over.is_set():
                os.write(ours, 50 * b"temperature 23\n")

    threading.Thread(target=talk, daemon=True).start()
    box = SerialTriggerBox(SerialConfig(port=os.ttyname(theirs), timeout_s=0.2))
    found: list[Exception] = []

    def connect() -> None:
        try:
            box.connect()
        except Exception as error:
            found.append(error)

    thread = threading.Thread(target=connect, daemon=True)
    thread.start()
    thread.join(30)
    over.set()
    assert [type(error) for error in found] == [DeviceError]
    assert "'temperature 23'. This is another device" in str(found[0])
    box.close()


def test_a_widget_that_sends_on_and_on_does_not_hold_its_lamps():
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    requests, shown = 0, b""

    def widget() -> None:
        nonlocal requests, shown
        with contextlib.suppress(OSError):
            while True:
                came = os.read(ours, 4096)
                shown = came[: came.find(b"\xe7") + 1] if came[1] == 6 else shown
                requests += (wanted := b"\x7e\x03" in came)
                if wanted and requests == 1:  # without the bytes that were asked for
                    os.write(ours, b"\x7e\x03\x05\x00\x90\x01\x09\x01\x28\xe7")
                if requests > 2:  # what it hears of DMX, over and over
                    while True:
                        os.write(ours, 50 * b"\x7e\x05\x03\x00\x00\x00\x01\xe7")

    threading.Thread(target=widget, daemon=True).start()
    config = DmxConfig(
        kind="dmx_enttec",
        port=os.ttyname(theirs),
        timeout_s=0.2,
        accept_unverified_blackout=True,
    )
    bank = DmxLightBank(config, 8)
    bank.connect()
    with pytest.raises(DeviceTimeout, match="putting lamp 3 on"):
        bank.select(3)
    requests += 1
    found: list[Exception] = []

    def off() -> None:
        try:
            bank.off()
        except Exception as error:
            found.append(error)

    thread = threading.Thread(target=off, daemon=True)
    thread.start()
    thread.join(30)
    assert [type(error) for error in found] == [DeviceTimeout]
    assert shown == b"\x7e\x06\x19\x00" + bytes(25) + b"\xe7"


def test_a_camera_gives_radiance(stage, world):
    camera = stage.cameras[0]
    assert camera.read(NEVER) is None
    camera.arm(0.005)
    stage.lights.select(99)
    stage.trigger.pulse(0.005)
    frame = camera.read(NEVER)
    assert frame is not None
    assert (frame.block_id, frame.exposure) == (1, 0.005)
    # 100 counts per 10 ms at 10,000 counts per (W/(sr m²) · s).
    np.testing.assert_allclose(frame.radiance(camera.info), 1.0, rtol=1e-6)
    assert frame.full_scale(camera.info) == pytest.approx((4095 - 64) / 50.0)
    camera.disarm()
    stage.trigger.pulse(0.005)
    assert camera.read(NEVER) is None


def test_a_saturated_count_is_at_full_scale_exactly(stage, world):
    camera = stage.cameras[0]
    for exposure in (0.0003, 0.007, 0.1, 1.7):
        camera.arm(exposure)
        world.cameras[camera.name]["queue"].append((1, 4095))
        frame = camera.read(NEVER)
        assert frame is not None
        assert (frame.radiance(camera.info) == np.float32(frame.full_scale(camera.info))).all()


def test_cameras_of_another_rig_are_refused(rig_file, stage):
    assert rig_file.devices is not None
    geometry = rig_file.rig.cameras[0]
    other = type(geometry).look_at("cam_0", 80, 60, [0, -1, 0], [0, 0, 0], 20)
    camera = LinkCamera(rig_file.devices.cameras, other)
    with pytest.raises(DeviceError, match="expected 80x60 pixels as in the rig file, received 8x6"):
        camera.connect()
    camera.close()
    stranger = type(geometry).look_at("cam_9", 8, 6, [0, -1, 0], [0, 0, 0], 20)
    camera = LinkCamera(rig_file.devices.cameras, stranger)
    with pytest.raises(DeviceError, match="received no camera cam_9"):
        camera.connect()
    camera.close()


HELLO = {"width": 8, "height": 6, "full_scale": 4095, "black": 64, "gain": 1e4, "bytes": 0}
FRAME = {"block_id": 1, "timestamp": 2.5, "exposure": 0.02, "left": 0, "bytes": 288}


@pytest.mark.parametrize("value", [math.nan, math.inf, None])
@pytest.mark.parametrize(
    ("hello", "field"), [*((True, f) for f in HELLO), *((False, f) for f in FRAME)]
)
def test_a_non_numeric_reply_raises_an_error_that_names_the_camera(rig_file, hello, field, value):
    replies = [HELLO | {field: value}, {}] if hello else [HELLO, {}, FRAME | {field: value}]

    def peer() -> None:
        with contextlib.suppress(OSError, struct.error), listener.accept()[0] as link:
            for fields in replies:
                link.recv(struct.unpack(">I", link.recv(4, socket.MSG_WAITALL))[0])
                text = json.dumps({"ok": True, "status": "frame", **fields}).encode()
                link.sendall(struct.pack(">I", len(text)) + text + bytes(288 * ("left" in fields)))

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=peer, daemon=True).start()
        config = LinkCamerasConfig(port=listener.getsockname()[1])
        camera = LinkCamera(config, rig_file.rig.cameras[0])

        def shoot() -> None:
            with contextlib.closing(camera):
                camera.connect()
                camera.arm(0.02)
                camera.read(NEVER)

        with pytest.raises(DeviceError, match=r"^camera cam_0 "):
            shoot()


def test_all_cameras_at_once_and_every_failure_is_named(stage, world, slack):
    cameras = FanOut(stage.cameras)
    assert cameras(lambda c: c.name) == {n: n for n in ("cam_0", "cam_1", "cam_2")}
    world.mute = {"cam_0", "cam_2"}
    start = time.monotonic()
    with pytest.raises(ExceptionGroup, match=r"cam_0.*cam_2|cam_2.*cam_0"):
        cameras(lambda c: c.read(NEVER))
    assert time.monotonic() - start < 1.8 * slack  # side by side: one deadline, not two
    cameras.close()
