"""DMX over a network: packets as other libraries make them, faults, and a killed service."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys

import pytest
from waiting import until

from reconstruction.geometry.rig import RigError
from simulators.peers.faults import Fault
from stage_service.device_config import ArtNetConfig, SacnConfig
from stage_service.devices.device_set import driver_for
from stage_service.devices.errors import DeviceError, DeviceTimeout, DeviceUnreachable

SACN, ART_NET = NETWORKS = "simulated sACN", "simulated Art-Net"
RAMP = bytes(range(256)) * 2


@pytest.fixture(params=NETWORKS)
def network(request):
    return request.param


def config_of(kind, **fields):
    known = {"kind": kind, "host": "127.0.0.2", "accept_unverified_blackout": True}
    return (SacnConfig if kind == "sacn" else ArtNetConfig).model_validate({**known, **fields})


def test_sacn_packets_are_those_of_another_library():
    sacn = pytest.importorskip("sacn", reason="sacn is missing: pip install sacn")
    driver = driver_for(config_of("sacn", universe=511, priority=123, channels=3), 331)
    for number, universe in enumerate((0, 1), 1):
        driver._sequence = 41 + number
        theirs = sacn.DataPacket.make_data_packet(driver.packet(universe, RAMP))
        assert (theirs.universe, theirs.priority, theirs.sequence) == (
            511 + universe,
            123,
            41 + number,
        )
        assert bytes(theirs.dmxData) == RAMP
        assert bytes(theirs.getBytes()) == driver.packet(universe, RAMP)
    assert driver.target(1) == ("127.0.0.2", 5568)
    multicast = driver_for(config_of("sacn", universe=511, host="", channels=3), 331)
    assert multicast.target(1) == (sacn.messages.data_packet.calculate_multicast_addr(512), 5568)


def test_art_net_packets_are_those_of_another_library():
    library = pytest.importorskip("stupidArtnet", reason="stupidArtnet is missing: pip install it")
    theirs = library.StupidArtnet("127.0.0.2")
    theirs.set_simplified(False)
    theirs.set_universe(3)
    theirs.set_subnet(2)
    theirs.set_net(1)
    driver = driver_for(config_of("artnet", universe=0x123), 8)
    assert driver.packet(0, RAMP) == bytes(theirs.packet_header) + RAMP
    theirs.close()


def test_lamps_of_three_channels_fill_universes_of_170():
    """A lamp is never split: 170 RGB lamps a universe, as lighting controllers number them."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as node:
        node.bind(("127.0.0.2", 0))
        port = node.getsockname()[1]
        driver = driver_for(config_of("sacn", port=port, channels=3), 331)
        driver.select(170)
        packets = [node.recv(1024) for _ in range(2)]
        driver.close()
    lit = [[i for i, level in enumerate(p[126:], 1) if level] for p in packets]
    assert [p[113:115].hex() for p in packets] == ["0001", "0002"]
    assert lit == [[], [1, 2, 3]]


@pytest.mark.parametrize(("kind", "first"), [("sacn", 63999), ("artnet", 32767)])
def test_universes_beyond_the_last_are_refused(kind, first):
    assert driver_for(config_of(kind, universe=first), 512).count == 512
    with pytest.raises(RigError, match=f"last universe would be {first + 1}"):
        driver_for(config_of(kind, universe=first), 513)


def test_a_lost_or_repeated_packet_has_no_effect(bench, network):
    one = bench(network)
    one.driver.select(5)
    one.driver.select(6)
    for kind in ("drop", "repeat"):
        one.faults.add(Fault("lights", kind, 0, request="dmx"))
        one.driver.off()
        assert one.lit() == []
        one.driver.select(6)
        assert one.lit() == [6]


def test_an_unchanged_frame_is_repeated_until_the_link_is_closed(bench, network):
    one = bench(network)
    one.driver.select(5)
    sent = one.peer.packets
    until(lambda: one.peer.packets >= sent + 4)
    one.driver.close()
    assert one.lit() == ([] if network == SACN else [5])
    one.driver.off()
    assert one.lit() == []


def test_a_receiver_that_is_gone_is_reported_and_comes_back(bench, network):
    one = bench(network)
    one.driver.select(5)
    one.faults.add(Fault("lights", "unplug", 0, request="dmx", seconds=0.5))
    with pytest.raises(DeviceUnreachable, match=r"lamps off: .*refused\. Its lamps may still be"):
        one.driver.off()
    until(lambda: goes_dark(one))
    assert one.lit() == []


def goes_dark(one):
    try:
        one.driver.off()
    except DeviceUnreachable:
        return False
    return True


def test_a_mute_or_overridden_receiver_is_never_taken_for_dark(bench, network):
    """Neither protocol confirms anything: the capabilities say so, and a blackout is not safe."""
    for kind in ("hang", "override"):
        one = bench(network)
        one.driver.all_on()
        assert len(one.lit()) == 200
        one.faults.add(Fault("lights", kind, 0))
        one.driver.off()
        assert len(one.lit()) == 200
        assert not one.driver.capabilities.reads_back
        assert not one.driver.capabilities.dead_man


@pytest.mark.parametrize("fault", ["silent", "drop", "late"])
def test_a_node_that_does_not_reply_is_reported(bench, fault):
    one = bench(ART_NET, Fault("lights", fault, 0, request="poll", seconds=0.5), connect=False)
    with pytest.raises(DeviceTimeout, match="polling the node: expected a reply within"):
        one.driver.connect()
    until(one.peer.idle)
    one.driver.connect()


@pytest.mark.parametrize(("state", "name"), [(2, "full"), (3, "scene")])
def test_a_node_that_lights_lamps_when_frames_stop_is_refused(bench, state, name):
    one = bench(ART_NET, connect=False)
    one.peer.fail_safe = state
    with pytest.raises(DeviceError, match=f"fail-safe zero or hold, received {name}"):
        one.driver.connect()
    one.peer.fail_safe = 1
    one.driver.connect()


def test_an_unknown_host_is_reported():
    driver = driver_for(config_of("sacn", host="no-such-host.invalid"), 8)
    with pytest.raises(DeviceUnreachable, match="opening the link"):
        driver.connect()


def test_killed_with_a_lamp_lit_sacn_goes_dark_and_art_net_stays_lit(bench, network):
    """As the hazards' page has it: E1.31 receivers notice the loss, a node by its own setting."""
    one = bench(network, connect=False)
    config = one.driver.config
    program = f"""
import time
from stage_service.device_config import ArtNetConfig, SacnConfig
from stage_service.devices.device_set import driver_for
config = {type(config).__name__}.model_validate_json({config.model_dump_json()!r})
driver = driver_for(config, 200)
driver.connect()
driver.select(5)
print("lit", flush=True)
time.sleep(600)
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as service:
        assert service.stdout is not None
        assert service.stdout.readline() == b"lit\n"
        assert one.lit() == [5]
        service.send_signal(signal.SIGKILL)
    if network == SACN:
        until(lambda: one.lit() == [])
    else:
        one.peer._stopping.wait(3)  # longer than a lost source is waited for
        assert one.lit() == [5]
