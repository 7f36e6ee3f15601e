"""A serial line that sends back what it gets, or adds to it: nothing of that is a reply."""

from __future__ import annotations

import pytest
from waiting import until

from simulators.peers.faults import Fault
from simulators.peers.terminal import Adapter
from stage_service.device_config import SerialConfig
from stage_service.devices.errors import DeviceError, DeviceTimeout
from stage_service.devices.projectors.interface import Pattern
from stage_service.devices.projectors.serial_controller import SerialProjectorController
from stage_service.devices.trigger.interface import TableRow
from stage_service.devices.trigger.serial_box import SerialTriggerBox

TIMEOUT_S = 0.25
ROWS = [Pattern(1.0, "left", row) for row in range(3)]
ECHO = Adapter(echo=True)
ADAPTERS = pytest.mark.parametrize(
    "adapter", [ECHO, Adapter(before=b"\r\n"), Adapter(after=b"\n\n")], ids=["echo", "LF", "LFs"]
)


@ADAPTERS
def test_a_trigger_box_behind_it(serial_stage, adapter):
    stage = serial_stage()
    stage.peers["trigger"].stand_behind(adapter)
    stage.trigger.connect()
    assert stage.trigger.pulse(0.001) == stage.wires.fired == 1
    assert stage.trigger.count() == 1
    assert not stage.trigger.status().estop_pressed
    stage.trigger.load_table([TableRow(2, "-", 0.0, 0.001, 0.0)], 30.0)
    stage.trigger.go()
    until(lambda: stage.trigger.progress().state == "done")
    assert stage.wires.fired == 3
    assert stage.trigger.stop() == 2


@ADAPTERS
def test_a_projector_controller_behind_it(serial_stage, adapter):
    stage = serial_stage()
    stage.peers["projectors"].stand_behind(adapter)
    stage.projectors.connect()
    stage.projectors.line("left", 2, 1.0)
    assert stage.controller.show.projector == "left"
    assert not stage.projectors.is_dark()
    stage.projectors.load_sequence(ROWS)
    assert stage.projectors.position() == 0
    stage.projectors.off()
    assert stage.projectors.is_dark()
    assert stage.controller.show.level == 0


@pytest.mark.parametrize("word", ["OFF", "SHOW?", "LINE", "PULSE", "STOP", "STATUS?"])
def test_an_echo_alone_is_no_reply(serial_stage, word):
    of_trigger = word in ("PULSE", "STOP", "STATUS?")
    name = "trigger" if of_trigger else "projectors"
    stage = serial_stage(Fault(name, "silent", 0, request=word), timeout_s=TIMEOUT_S)
    stage.peers[name].stand_behind(ECHO)
    calls = {
        "OFF": stage.projectors.off,
        "SHOW?": stage.projectors.is_dark,
        "LINE": lambda: stage.projectors.line("right", 1, 1.0),
        "PULSE": lambda: stage.trigger.pulse(0.001),
        "STOP": stage.trigger.stop,
        "STATUS?": stage.trigger.status,
    }
    with pytest.raises(DeviceTimeout, match="received only an echo"):
        calls[word]()
    calls[word]()  # it identifies itself first, and the next reply is the next request's
    assert stage.trigger.count() == stage.wires.fired


@pytest.mark.parametrize("make", [SerialTriggerBox, SerialProjectorController])
def test_an_echoing_port_is_distinguished_from_another_device(serial_stage, slack, make):
    stage = serial_stage()
    peer = stage.peers["trigger"]
    peer._reply = lambda _line: ""
    peer.stand_behind(ECHO)
    stage.trigger.close()
    config = SerialConfig(port=str(peer.link), timeout_s=TIMEOUT_S * slack)
    driver = make(config) if make is SerialTriggerBox else make(config, ("left",))
    with pytest.raises(DeviceError, match=r"received 'ID\?'. The line echoes") as e:
        driver.connect()
    assert "\\d" not in str(e.value)
    driver.close()
