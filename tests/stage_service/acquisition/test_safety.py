"""Blackout, where a device answers with something that nobody foresaw."""

from types import SimpleNamespace

import pytest

from stage_service.acquisition.safety import blackout
from stage_service.devices.errors import DeviceTimeout
from stage_service.devices.lights.interface import LightCapabilities, LightStatus
from stage_service.devices.projectors.interface import ProjectorCapabilities


class Broken:
    """A light bank whose driver has a fault of its own."""

    name = "lights"
    capabilities = LightCapabilities(reads_back=True, dead_man=True, table=0)

    def off(self):
        raise ZeroDivisionError("a fault of the driver")


class Beams:
    name = "projectors"
    capabilities = ProjectorCapabilities(reads_back=True, dead_man=False, table=0)
    lit = True

    def off(self):
        self.lit = False

    def is_dark(self):
        return not self.lit


class Contradicted(Broken):
    """A light bank that reports every lamp as off, as it did while they were commanded on."""

    contradicted = True

    def off(self):
        pass

    def status(self):
        return LightStatus(False, False, False, 0)


class Stopped(Contradicted):
    """A light bank whose lamps are off by more than the command."""

    contradicted = False

    def __init__(self, *causes: bool) -> None:
        self.causes = causes

    def status(self):
        return LightStatus(*self.causes, 0)


class Silent:
    """A light bank that obeys and cannot say so."""

    name = "lights"
    capabilities = LightCapabilities(reads_back=False, dead_man=False, table=0)
    dead = False

    def off(self):
        if self.dead:
            raise DeviceTimeout("lights", "off", expected="an answer", received="", todo="")


def stage(lights, beams, *, accepts=False):
    accepted = SimpleNamespace(accept_unverified_blackout=accepts)
    config = SimpleNamespace(watchdog_s=2.0, lights=accepted)
    return SimpleNamespace(lights=lights, projectors=beams, config=config)


def test_a_fault_of_one_driver_does_not_keep_the_projectors_lit():
    beams = Beams()
    result = blackout(stage(Broken(), beams), attempts=1)
    assert not beams.lit
    assert not result.safe
    assert "ZeroDivisionError: a fault of the driver" in result.detail
    assert "Its watchdog acts 2 s after the service's last heartbeat; a light" in result.detail
    assert result.blocks


def test_dark_by_a_contradicted_read_back_is_reported_as_such():
    result = blackout(stage(Contradicted(), Beams()))
    assert result.state == "dark"
    assert "earlier lights reported lamps as off that were commanded on" in result.detail


@pytest.mark.parametrize(
    ("causes", "named"),
    [
        ((True, False, False), "its watchdog has tripped"),
        ((False, True, False), "the interlock is open"),
        ((False, False, True), "the emergency stop is pressed"),
        ((False, True, True), "the interlock is open, the emergency stop is pressed"),
    ],
)
def test_other_causes_of_dark_lamps_are_named_in_the_detail(causes, named):
    result = blackout(stage(Stopped(*causes), Beams()))
    dark = "every lamp and projector was read back dark"
    assert (result.state, result.detail) == ("dark", f"{dark}; lights reported then: {named}")
    assert blackout(stage(Stopped(False, False, False), Beams())).detail == dark


def test_lamps_without_read_back_are_unknown_and_block_unless_accepted():
    unread = blackout(stage(Silent(), Beams()), attempts=1)
    assert (unread.state, unread.blocks) == ("unknown, unsafe", True)
    accepted = blackout(stage(Silent(), Beams(), accepts=True), attempts=1)
    assert (accepted.state, accepted.blocks) == ("unknown, unsafe", False)
    assert accepted.detail.endswith("off was sent, but cannot be read back.")
    broken = Silent()
    broken.dead = True
    assert blackout(stage(broken, None, accepts=True), attempts=1).blocks
