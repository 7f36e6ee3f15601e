"""One contract of every light bank, on every wire and against every peer."""

from __future__ import annotations

import socket

import numpy as np
import pytest

from reconstruction.geometry.rig import RigError
from stage_service.device_config import DmxConfig, ModbusTcpConfig
from stage_service.devices.errors import DeviceError, DeviceUnreachable
from stage_service.devices.lights.dmx_enttec import DmxLightBank
from stage_service.devices.lights.modbus import ModbusLightBank

WHOLE = ("simulated TCP", "simulated RTU", "simulated RTU, other registers")
FOREIGN = ("pyModbusTCP", "the tests' own peer")
NETWORKS = ("simulated sACN", "simulated Art-Net")
BARE = ("simulated TCP, coils alone", "simulated DMX", *NETWORKS)
ALL = (*WHOLE, *FOREIGN, *BARE)


@pytest.fixture(params=ALL)
def any_bank(request, bench):
    return bench(request.param)


@pytest.fixture(params=(*WHOLE, *FOREIGN))
def bank(request, bench):
    """One with everything."""
    return bench(request.param)


@pytest.fixture(params=WHOLE)
def gated(request, bench):
    """One whose lamps the test can gate."""
    now = [100.0]
    one = bench(request.param, clock=lambda: now[0])
    one.now = now
    return one


def test_the_bank_lights_exactly_the_commanded_lamps(any_bank):
    driver = any_bank.driver
    assert driver.count == 200
    driver.off()
    assert any_bank.lit() == []
    for lamp in (0, 7, 8, 199):
        driver.select(lamp)
        assert any_bank.lit() == [lamp]
    driver.all_on()
    assert any_bank.lit() == list(range(200))
    driver.select(3)
    driver.off()
    assert any_bank.lit() == []


GRADED = [round(i / 199, 2) for i in range(200)]


def test_several_lamps_are_lit_at_once_each_at_its_own_level(any_bank):
    driver = any_bank.driver
    driver.all_on()
    some = [float(i in (1, 8, 198)) for i in range(200)]
    driver.show(some)
    assert any_bank.lit() == [1, 8, 198]
    driver.set_level(1.0)
    driver.select(2)
    assert any_bank.lit() == [2]
    for wrong in ([1.0], [*some, 1.0], [2.0, *some[1:]], [-0.1, *some[1:]]):
        with pytest.raises(ValueError, match="level"):
            driver.show(wrong)
    assert any_bank.lit() == [2]
    driver.show(some)
    driver.off()
    assert any_bank.lit() == []


@pytest.mark.parametrize("kind", [k for k in ALL if k != "simulated TCP, coils alone"])
def test_levels_of_several_lamps_are_as_commanded(bench, kind):
    one = bench(kind)
    one.driver.set_level(0.25)
    one.driver.show(GRADED)
    np.testing.assert_allclose(one.powers(), GRADED, atol=0.5 / 255)
    assert one.lit() == list(range(1, 200))
    one.driver.set_level(0.25)  # the level of the call above, which no lamp has after `show`
    np.testing.assert_allclose([one.powers()[i] for i in one.lit()], 0.25, atol=0.5 / 255)
    one.driver.all_on()
    np.testing.assert_allclose(one.powers(), 0.25, atol=0.5 / 255)


def test_a_bank_without_levels_refuses_grey_before_a_lamp_changes(bench):
    one = bench("simulated TCP, coils alone")
    one.driver.select(3)
    with pytest.raises(DeviceError, match="expected levels, received a light bank without"):
        one.driver.show(GRADED)
    assert one.lit() == [3]


@pytest.mark.parametrize("kind", WHOLE)
def test_no_lamp_takes_another_pattern_s_level(bench, kind, monkeypatch):
    """While the levels of a pattern are written, all lamps are off."""
    one = bench(kind)
    one.driver.all_on()
    lit = []
    dim = one.lamps.dim
    monkeypatch.setattr(
        one.lamps, "dim", lambda *words: (lit.append(one.lamps.power().any()), dim(*words))
    )
    one.driver.show(GRADED)
    assert lit == [False, False]  # 122 levels, then the rest


def test_lamps_that_are_not_there_are_refused(any_bank):
    for lamp in (-1, 200):
        with pytest.raises(ValueError, match=f"lamps are 0 to 199, got {lamp}"):
            any_bank.driver.select(lamp)
    assert any_bank.lit() == []


@pytest.mark.parametrize("kind", [k for k in ALL if k != "simulated TCP, coils alone"])
def test_levels_hold_for_every_lamp(bench, kind):
    one = bench(kind)
    one.driver.set_level(0.5)
    one.driver.all_on()
    np.testing.assert_allclose(one.powers(), 0.5, atol=0.5 / 255)
    one.driver.set_level(1.0)
    one.driver.select(9)
    assert one.powers()[9] == 1.0
    for level in (-0.1, 1.1):
        with pytest.raises(ValueError, match="a level is 0 to 1"):
            one.driver.set_level(level)


def test_missing_capabilities_raise_errors_and_have_flags(any_bank):
    driver = any_bank.driver
    can = driver.capabilities
    if can.reads_back:
        assert driver.status().lit == 0
    else:
        with pytest.raises(DeviceError, match="a light bank without"):
            driver.status()
    if can.dead_man:
        driver.set_watchdog(60.0)
        driver.heartbeat()
    else:
        for call in (driver.heartbeat, lambda: driver.set_watchdog(1.0)):
            with pytest.raises(DeviceError, match="a light bank without"):
                call()
    if can.table:
        driver.load_sequence([(0, 1.0)])
        assert driver.position() == 0
        driver.off()
    else:
        for call in (driver.position, lambda: driver.load_sequence([(0, 1.0)])):
            with pytest.raises(DeviceError, match="a light bank without"):
                call()


def test_status_counts_what_is_lit(bank):
    bank.driver.all_on()
    status = bank.driver.status()
    assert (status.lit, status.watchdog_tripped, status.estop_pressed) == (200, False, False)


def test_a_watchdog_time_out_of_range_is_refused_by_the_bank(bank):
    with pytest.raises(DeviceError, match=r"watchdog to 0.05 s: .*Modbus exception 3"):
        bank.driver.set_watchdog(0.05)
    bank.driver.select(5)
    assert bank.lit() == [5]


def test_an_armed_sequence_is_dark_refuses_the_selector_and_is_left_by_off(bank):
    driver = bank.driver
    driver.select(3)
    driver.load_sequence([(i % 200, 1.0) for i in range(331)])
    assert bank.lit() == []
    assert driver.position() == 0
    with pytest.raises(DeviceError, match="Modbus exception 4"):
        driver.select(1)
    driver.off()
    driver.select(1)
    assert bank.lit() == [1]


def test_the_gate_steps_a_sequence(gated):
    entries = [("none", 1.0), ("all", 0.25), (7, 1.0), (199, 0.5)]
    gated.driver.load_sequence(entries)
    recorded = []
    for _ in entries:
        gated.lamps.gate(True)
        recorded.append((gated.lit(), max(gated.powers())))
        gated.lamps.gate(False)
        assert gated.lit() == []
    assert [lit for lit, _ in recorded] == [[], list(range(200)), [7], [199]]
    np.testing.assert_allclose([p for _, p in recorded], [0, 0.25, 1, 0.5], atol=0.5 / 255)
    assert gated.driver.position() == 4
    gated.lamps.gate(True)
    assert gated.lit() == []
    gated.lamps.gate(False)
    with pytest.raises(DeviceError, match="at most 4 steps, as armed, received 5"):
        gated.driver.position()
    gated.driver.set_level(1.0)  # entries have set levels behind the driver's back
    gated.driver.off()
    gated.driver.all_on()
    assert set(gated.powers()) == {1.0}


def test_a_table_of_any_length_arrives_whole(gated):
    # 61 and 62 entries are the last of one chunk and the first of the next.
    for length in (1, 61, 62, 4096):
        gated.driver.load_sequence([((7 * i) % 200, 1.0) for i in range(length)])
        words = gated.lamps.table()[: 2 * length : 2]
        assert words == [(7 * i) % 200 + 1 for i in range(length)]
    for wrong in ([], [(0, 1.0)] * 4097):
        with pytest.raises(ValueError, match="a sequence has 1 to 4096 steps"):
            gated.driver.load_sequence(wrong)
    with pytest.raises(ValueError, match="lamps are 0 to 199, got 200"):
        gated.driver.load_sequence([(200, 1.0)])


def test_lamps_go_off_when_the_heartbeat_stops(gated):
    gated.driver.set_watchdog(0.5)
    gated.driver.heartbeat()
    gated.driver.all_on()
    gated.now[0] += 0.51
    assert gated.lit() == []
    assert gated.driver.status().watchdog_tripped
    gated.driver.heartbeat()
    assert not gated.driver.status().watchdog_tripped
    assert gated.lit() == []


def test_short_flashes_of_a_sequence_do_not_keep_the_watchdog_from_tripping(gated):
    gated.driver.set_watchdog(0.5)
    gated.driver.load_sequence([(0, 1.0)] * 10)
    for _ in range(6):
        gated.lamps.gate(True)
        gated.now[0] += 0.05
        gated.lamps.gate(False)
        gated.now[0] += 0.05
    gated.lamps.gate(True)
    assert gated.lit() == []
    assert gated.driver.status().watchdog_tripped


@pytest.mark.parametrize("kind", BARE)
def test_a_bank_that_cannot_guarantee_a_blackout_is_refused(bench, kind):
    one = bench(kind, connect=False)
    one.driver.config = one.driver.config.model_copy(update={"accept_unverified_blackout": False})
    with pytest.raises(DeviceError) as refusal:
        one.driver.connect()
    text = str(refusal.value)
    assert "lit lamps stay lit" in text
    assert "cannot confirm that the lamps are off" in text
    assert "accept_unverified_blackout = true" in text
    assert one.requests == []


def test_a_bank_of_another_size_is_refused(bench):
    one = bench("simulated TCP", lamps=24, connect=False)
    driver = ModbusLightBank(one.driver.config, 331)
    with pytest.raises(DeviceError, match="expected 331 lamps as in the rig file, received 24"):
        driver.connect()
    driver.close()


def test_another_device_is_refused(bench):
    one = bench("simulated TCP", connect=False)
    registers = one.driver.config.registers.model_copy(update={"signature": (3, 0x1234)})
    driver = ModbusLightBank(one.driver.config.model_copy(update={"registers": registers}), 200)
    with pytest.raises(DeviceError, match="input register 3 to be 0x1234, received 0x4853"):
        driver.connect()
    driver.close()


def test_missing_bank_is_reported_with_the_reason():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    driver = ModbusLightBank(ModbusTcpConfig(port=port, timeout_s=0.2), 3)
    with pytest.raises(DeviceUnreachable, match="Connection refused"):
        driver.connect()
    bank = DmxLightBank(
        DmxConfig(kind="dmx_enttec", port="/dev/none", accept_unverified_blackout=True), 3
    )
    with pytest.raises(DeviceUnreachable, match="/dev/none"):
        bank.connect()


@pytest.mark.parametrize(("first", "lamps"), [(1, 513), (200, 331)])
def test_more_lamps_than_a_universe_has_channels_are_refused(first, lamps):
    config = DmxConfig(kind="dmx_enttec", port="x", first_channel=first)
    with pytest.raises(RigError, match="a DMX universe has 512"):
        DmxLightBank(config, lamps)
    assert DmxLightBank(DmxConfig(kind="dmx_enttec", port="x"), 331).count == 331


@pytest.mark.parametrize(
    ("registers", "lamps", "message"),
    [
        ({}, 1001, "selector overlaps levels at 1000"),
        ({"levels": 900, "owner": "none"}, 331, "selector overlaps levels at 1000"),
        ({"heartbeat": 1002}, 331, "watchdog overlaps heartbeat at 1002"),
        ({"owner": 990}, 331, "owner overlaps selector at 1000"),
        ({"levels": 1990}, 331, "table overlaps levels at 2000"),
        ({"levels": 10_191}, 331, "table overlaps levels at 10191"),  # the last of 4096 entries
    ],
)
def test_overlapping_registers_are_refused(registers, lamps, message):
    """By the wire's page, 65535 at the selector puts all lamps on: as a level it is full."""
    config = ModbusTcpConfig.model_validate({"registers": registers})
    with pytest.raises(RigError, match=message):
        ModbusLightBank(config, lamps)


def test_dmx_levels_are_rounded_to_8_bits_and_none_vanishes(bench):
    one = bench("simulated DMX")
    one.driver.all_on()
    for level, word in ((0.5, 128), (0.02, 5), (0.002, 1), (0.0, 0)):
        one.driver.set_level(level)
        assert set(one.powers()) == {word / 255}
    with pytest.raises(DeviceError, match=r"more than 0\.00196: it has 255 levels above 0"):
        one.driver.set_level(0.0019)


def test_it_keeps_who_has_it(bank):
    driver = bank.driver
    assert driver.claim(7, "left:123") is None
    assert driver.claim(7, "left:124") is None  # the same service, started anew
    driver.close()  # a connection decides nothing
    assert driver.claim(9, "right:5") == "left:124"
    driver.all_on()
    driver.off()  # who has the bank is for services to heed; off is for everybody
    assert driver.claim(9, "right:5") == "left:124"
    assert driver.claim(0, "") is None
    assert driver.claim(9, 40 * "ü") is None
    assert driver.claim(65535, "x") == 32 * "?"


def test_an_owner_without_a_name_is_one(bank):
    first = bank.driver.config.registers.owner
    bank.driver._exchange("claiming", "write_register", first, 300)
    assert bank.driver.claim(7, "left:123") == "a service that gave no name (300)"


def test_restarted_or_taken_over_bank_is_reported_at_the_next_heartbeat(gated):
    driver, lamps = gated.driver, gated.lamps
    driver.heartbeat()  # nobody's as yet
    assert driver.claim(7, "left:123") is None
    driver.set_level(0.25)
    driver.heartbeat()
    lamps.own(0, [0])  # a power-up, by the wire's page
    lamps.dim(0, [65535] * driver.count)
    with pytest.raises(DeviceError, match=r"service 7's, received no owner"):
        driver.heartbeat()
    lamps.own(0, [9])
    with pytest.raises(DeviceError, match=r"service 7's, received service 9"):
        driver.heartbeat()
    lamps.own(0, [0])
    assert driver.claim(7, "left:123") is None
    driver.heartbeat()
    driver.set_level(0.25)  # which it was set to before
    driver.select(3)
    assert gated.powers()[3] == pytest.approx(0.25, abs=1 / 255)
    assert driver.claim(0, "") is None
    driver.heartbeat()
