"""The `[safety]` limits of lamps: in a plan, and on a bank that is told to exceed them."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter
from waiting import until

from stage_service.config import RigFile, SafetyLimits, load_rig_file
from stage_service.device_config import LightBankConfig, LightRegisters, ModbusTcpConfig
from stage_service.devices.errors import DeviceTimeout, SafetyRefusal
from stage_service.devices.lights.interface import LightCapabilities, LightStatus, Lit
from stage_service.devices.lights.limited import LimitedLightBank
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.limits import longest_on
from stage_service.plan.resolved import PlanError, resolve

pytestmark = pytest.mark.usefixtures("permitted")
RIGS = Path(__file__).resolve().parents[3] / "stage_service" / "rigs"
LAMPS = 10


class Bank:
    """A light bank in memory: what the wrapper sends on, it does."""

    name = "lights"
    capabilities = LightCapabilities(reads_back=True, dead_man=True, table=8)
    count = LAMPS

    def __init__(self) -> None:
        self.lit: set[int] = set()
        self.heartbeats = 0
        self.dead = False
        self.was_put_off = threading.Event()

    def select(self, lamp: int) -> None:
        self.lit = {lamp}

    def all_on(self) -> None:
        self.lit = set(range(self.count))

    def show(self, levels: Sequence[float]) -> None:
        self.lit = {i for i, level in enumerate(levels) if level > 0}

    def off(self) -> None:
        if self.dead:
            raise DeviceTimeout("lights", "off", expected="", received="", todo="")
        self.lit = set()
        self.was_put_off.set()

    def heartbeat(self) -> None:
        self.heartbeats += 1

    def status(self) -> LightStatus:
        return LightStatus(False, False, False, len(self.lit))

    def load_sequence(self, entries: Sequence[tuple[Lit, float]]) -> None:
        self.entries = list(entries)

    def connect(self) -> None: ...
    def close(self) -> None: ...
    def set_level(self, level: float) -> None: ...
    def set_watchdog(self, seconds: float) -> None: ...
    def position(self) -> int:
        return 3


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def limited(monkeypatch) -> Any:
    """Makes a wrapper over a new bank: (bank, wrapper, clock); closes it afterwards. Its thread
    does not run: it waits by the machine's clock, and would come between on a busy machine."""
    monkeypatch.setattr(LimitedLightBank, "_watch", lambda _: None)
    made = []

    def make(**limits: Any) -> tuple[Bank, LimitedLightBank, Clock]:
        bank, clock = Bank(), Clock()
        wrapper = LimitedLightBank(bank, SafetyLimits(**limits), clock)
        made.append(wrapper)
        return bank, wrapper, clock

    yield make
    for wrapper in made:
        wrapper.close()


def test_a_lamp_that_stays_lit_is_put_off_and_the_next_command_names_it(limited):
    bank, lights, clock = limited(max_on_s=2.0)
    lights.select(7)
    clock.now += 1.5
    assert lights.enforce() == pytest.approx(0.5)
    assert bank.lit == {7}
    clock.now += 0.5
    lights.enforce()
    assert bank.lit == set()
    for command in (lights.status, lights.heartbeat, lights.all_on, lambda: lights.select(1)):
        with pytest.raises(SafetyRefusal, match=r"lamp 7 lit: expected at most 2 s \(max_on_s"):
            command()
    assert bank.heartbeats == 0
    lights.off()
    assert lights.status().lit == 0, "a blackout reads back"
    with pytest.raises(SafetyRefusal, match="lamp 7"):
        lights.select(1)
    lights.connect()
    lights.select(1)
    assert bank.lit == {1}


def test_after_a_standstill_a_lamp_counts_as_commanded_on_not_as_lit(limited):
    """The bank's watchdog has put it off meanwhile: how long it was lit, nobody here knows."""
    _, lights, clock = limited(max_on_s=12.0)
    lights.select(7)
    clock.now += 26.1
    lights.enforce()
    with pytest.raises(SafetyRefusal, match=r"commanded on for 26\.1 s.*that stood still"):
        lights.status()


def test_a_change_of_lamps_begins_anew_and_the_same_lamp_does_not(limited):
    bank, lights, clock = limited(max_on_s=2.0)
    for lamp in (0, 1, 2):
        lights.select(lamp)
        clock.now += 1.5
    assert lights.enforce() == pytest.approx(0.5)
    lights.all_on()
    assert lights.enforce() == pytest.approx(0.5), "lamp 2 was lit before"
    clock.now += 1.0
    with pytest.raises(SafetyRefusal, match=r"putting lamp 2 on.*max_on_s"):
        lights.select(2)
    assert bank.lit == set()


def test_the_thread_puts_lamps_off_by_itself():
    bank = Bank()
    lights = LimitedLightBank(bank, SafetyLimits(max_on_s=0.05))
    lights.select(3)
    assert bank.was_put_off.wait(5.0)
    with pytest.raises(SafetyRefusal, match="keeping lamp 3 lit"):
        lights.heartbeat()
    lights.close()
    assert "lamp limits" not in {t.name for t in threading.enumerate()}


def test_a_budget_that_ends_sooner_wakes_the_thread_sooner():
    bank, clock = Bank(), Clock()
    limits = SafetyLimits(max_on_s=60.0, max_duty=0.5, duty_window_s=100.0)
    lights = LimitedLightBank(bank, limits, clock)
    lights.select(0)
    clock.now += 49.99
    lights.off()
    with lights._changed:
        lights._changed.notify_all()
    until(lambda: lights._wakes > clock.now + 50.0)  # nothing is lit: the thread sleeps for long
    bank.was_put_off.clear()
    lights.select(0)  # hardly anything of the budget is left: the thread must look again
    clock.now += 0.02
    assert bank.was_put_off.wait(20.0)
    lights.close()
    assert bank.lit == set()


def test_a_bank_that_does_not_obey_gets_no_heartbeats_and_is_tried_again(limited):
    bank, lights, clock = limited(max_on_s=1.0)
    lights.select(0)
    bank.dead = True
    clock.now += 1.0
    assert lights.enforce() < 1.0
    with pytest.raises(SafetyRefusal):
        lights.heartbeat()
    bank.dead = False
    lights.enforce()
    assert bank.lit == set()


def test_the_duty_counts_within_any_window(limited):
    bank, lights, clock = limited(max_duty=0.5, duty_window_s=10.0)
    lights.select(4)
    clock.now += 3.0
    lights.off()
    clock.now += 1.0
    lights.select(4)
    assert lights.enforce() == pytest.approx(2.0)
    clock.now += 2.0
    lights.enforce()
    assert bank.lit == set()
    lights.off()
    lights.connect()
    with pytest.raises(SafetyRefusal, match=r"at most 5 s of 10 s \(max_duty.*lit for 5 s"):
        lights.select(4)
    lights.select(5)
    clock.now += 4.5  # 10.5 s after lamp 4 was first lit: half a second of it is outside now
    lights.select(4)
    assert lights.enforce() == pytest.approx(0.5)


def test_the_duty_counts_what_the_trigger_box_clocks(limited):
    _, lights, clock = limited(max_duty=0.5, duty_window_s=10.0)
    lights.load_sequence([(4, 1.0), (5, 1.0), (4, 1.0)], [(0.0, 3.0), (3.0, 4.0), (4.0, 6.0)])
    clock.now += 6.0
    lights.off()
    with pytest.raises(SafetyRefusal, match=r"at most 5 s of 10 s \(max_duty.*lit for 5 s"):
        lights.select(4)
    with pytest.raises(SafetyRefusal, match=r"entry 1 of a sequence.*lit for 5\.5 s"):
        lights.load_sequence([(5, 1.0), (4, 1.0)], [(0.0, 1.0), (1.0, 1.5)])
    lights.load_sequence([(4, 1.0)], [(5.0, 7.0)])  # the first 3 s are outside of the window then
    clock.now += 6.0
    lights.off()  # of the 2 s, 1 s came
    clock.now += 2.0
    lights.select(4)  # 3 s of the last 10
    assert lights.enforce() == pytest.approx(2.0)


def test_lamps_and_power_are_checked_before_anything_lights(limited):
    bank, lights, _ = limited(max_lamps=9)
    with pytest.raises(SafetyRefusal, match=r"at most 9 lamps lit.*10 requested"):
        lights.all_on()
    with pytest.raises(SafetyRefusal, match="entry 1 of a sequence"):
        lights.load_sequence([(0, 1.0), ("all", 0.1)])
    lights.load_sequence([(0, 1.0), ("none", 0.1)])
    assert bank.entries == [(0, 1.0), ("none", 0.1)]
    assert (bank.lit, lights.position()) == (set(), 3)

    bank, lights, _ = limited(max_power_w=20.0, lamp_power_w=10.0)
    with pytest.raises(SafetyRefusal, match=r"at most 20 W.*10 lamps at level 1, 100 W"):
        lights.all_on()  # the level is not known: taken as full
    lights.set_level(0.2)
    lights.all_on()
    with pytest.raises(SafetyRefusal, match=r"10 lamps at level 0\.3, 30 W"):
        lights.set_level(0.3)
    with pytest.raises(SafetyRefusal, match="entry 0"):
        lights.load_sequence([("all", 0.25)])
    assert bank.lit == set(range(LAMPS))


def levels_of(**levels: float) -> list[float]:
    return [levels.get(f"lamp_{i}", 0.0) for i in range(LAMPS)]


def test_the_lamps_of_a_pattern_are_counted_and_their_power_added(limited):
    bank, lights, _ = limited(max_lamps=3, max_power_w=15.0, lamp_power_w=10.0)
    lights.show(levels_of(lamp_0=1.0, lamp_4=0.25, lamp_9=0.25))  # 15 W
    assert bank.lit == {0, 4, 9}
    with pytest.raises(SafetyRefusal, match=r"at most 15 W .*received 2 lamps at level 0\.8, 16 W"):
        lights.show(levels_of(lamp_0=1.0, lamp_1=0.6))
    with pytest.raises(SafetyRefusal, match=r"at most 3 lamps lit .*received 4 requested"):
        lights.show(levels_of(lamp_0=0.1, lamp_1=0.1, lamp_2=0.1, lamp_3=0.1))
    with pytest.raises(SafetyRefusal, match="3 lamps at level 1, 30 W"):
        lights.set_level(1.0)  # of the lamps that the pattern has lit
    assert bank.lit == {0, 4, 9}


def test_after_a_pattern_lamps_may_have_its_highest_level(limited):
    """A bank whose level registers a pattern has written keeps them."""
    _, lights, _ = limited(max_power_w=15.0, lamp_power_w=10.0)
    lights.set_level(0.1)
    lights.show(levels_of(lamp_0=0.9, lamp_1=0.1))
    lights.off()
    with pytest.raises(SafetyRefusal, match=r"10 lamps at level 0\.9, 90 W"):
        lights.all_on()
    lights.set_level(0.1)
    lights.all_on()


def test_each_lamp_of_a_pattern_has_its_own_time_and_duty(limited):
    bank, lights, clock = limited(max_on_s=5.0, max_duty=0.5, duty_window_s=10.0)
    lights.select(3)
    clock.now += 3.0
    lights.show(levels_of(lamp_3=0.1, lamp_4=1.0))
    assert lights.enforce() == pytest.approx(2.0), "lamp 3 was lit before, however dim now"
    clock.now += 2.0
    lights.enforce()
    assert bank.lit == set()
    lights.off()
    lights.connect()
    clock.now += 1.0
    with pytest.raises(SafetyRefusal, match=r"lit for 5 s.*Let the lamp cool"):
        lights.show(levels_of(lamp_3=0.1, lamp_5=1.0))
    lights.show(levels_of(lamp_4=0.1, lamp_5=1.0))
    assert bank.lit == {4, 5}


def test_a_pattern_that_is_none_lights_nothing(limited):
    bank, lights, _ = limited()
    for wrong in (levels_of(), levels_of(lamp_0=1.1), levels_of(lamp_0=float("nan"), lamp_1=1.0)):
        with pytest.raises(ValueError, match="levels of 0 to 1, at least one lit"):
            lights.show(wrong)
    assert bank.lit == set()


@pytest.fixture(scope="module")
def demo() -> RigFile:
    return load_rig_file(RIGS / "demo.toml")


@pytest.mark.parametrize(
    ("limits", "plan", "problem"),
    [
        (
            {"max_on_s": 1.0},
            {"exposure": {"olat": 2.0}},
            "exposure.olat: step 2 has a lamp lit for 2 s; [safety] max_on_s allows 1 s",
        ),
        (
            {"max_lamps": 100},
            {},
            "all_on: 331 lamps would be lit at once; [safety] max_lamps allows 100",
        ),
        (
            {"max_power_w": 50.0},
            {},
            "level.all_on: 331 lamps at level 0.02 draw 66.2 W; [safety] max_power_w allows 50 W: "
            "at most level 0.0151",
        ),
        (
            {"max_duty": 0.01, "duty_window_s": 10.0},
            {"lights": ("light_003",), "exposure": {"olat": 0.2}},
            "lamp light_003 would be lit 0.2",
        ),
    ],
)
def test_a_plan_that_exceeds_a_limit_is_refused_with_numbers(demo, limits, plan, problem):
    rig_file = replace(demo, safety=SafetyLimits(**limits))
    with pytest.raises(PlanError) as error:
        resolve(CapturePlan(projectors=(), **plan), rig_file)
    assert problem in str(error.value)


DMX = {"kind": "dmx_enttec", "port": "p", "accept_unverified_blackout": True}
COILS = {
    "kind": "modbus_rtu",
    "port": "p",
    "registers": {"levels": "none", "sequence": "none", "selector": "none"},
}


@pytest.mark.parametrize(
    ("bank", "level", "problem"),
    [
        (DMX, {"olat": 0.5 / 255}, "level.olat: the light bank of [devices.lights] has 255 levels"),
        (DMX, {"olat": 0.5 / 255 + 1e-9, "all_on": 0.5 / 255 + 1e-9}, None),
        (DMX, {"all_on": 1e-4}, "that 0.0001 would be dark: use one above 0.00196 and a shorter"),
        ({"kind": "modbus_tcp"}, {"all_on": 1e-4}, None),
        ({"kind": "modbus_tcp"}, {"all_on": 5e-6}, "has 65535 levels above 0, so that 5e-06 would"),
        (
            COILS,
            {"olat": 1, "all_on": 0.5},
            "level.all_on: the light bank of [devices.lights] has no",
        ),
        (COILS, {"olat": 1, "all_on": 1}, None),
    ],
)
def test_a_level_that_the_bank_does_not_have_is_refused_in_the_plan(demo, bank, level, problem):
    lights = TypeAdapter(LightBankConfig).validate_python(bank)
    assert demo.devices is not None
    rig_file = replace(demo, devices=demo.devices.model_copy(update={"lights": lights}))
    plan = CapturePlan(projectors=(), stepping="software", level=level)
    if problem is None:
        resolve(plan, rig_file)
        return
    with pytest.raises(PlanError) as error:
        resolve(plan, rig_file)
    assert len(error.value.problems) == 1
    assert problem in error.value.problems[0]


def test_a_sweep_that_the_projectors_would_not_show_is_refused(demo):
    """Their wire has 65535 levels above 0 (docs/reference/wire.md): 0.5 / 65535 is 7.63e-6."""
    sweep = {"lights": (), "sentinels": False}
    resolve(CapturePlan(level={"scanline": 7.7e-6}, **sweep), demo)
    with pytest.raises(PlanError, match=r"level\.tracking: the projector controller") as error:
        resolve(CapturePlan(level={"scanline": 7.7e-6, "tracking": 7.6e-6}, **sweep), demo)
    assert len(error.value.problems) == 1
    assert "so that 7.6e-06 would be dark" in error.value.problems[0]


def test_entries_of_a_table_have_levels_where_the_lamps_have_none(demo):
    without = LightRegisters(levels=None)
    lights = ModbusTcpConfig(registers=without, accept_unverified_blackout=True)
    devices = demo.devices.model_copy(update={"lights": lights, "hardware_stepping": True})
    rig_file = replace(demo, devices=devices)
    plan = CapturePlan(projectors=(), sentinels=False, level={"olat": 0.5}, stepping="hardware")
    assert resolve(plan, rig_file).cost.stepping["software"] == 0
    with pytest.raises(PlanError, match="has no levels"):
        resolve(plan.model_copy(update={"stepping": "software"}), rig_file)


def test_a_plan_within_its_limits_passes(demo):
    limits = SafetyLimits(max_on_s=0.1, max_duty=0.1, max_power_w=70.0, max_lamps=331)
    assert resolve(CapturePlan(), replace(demo, safety=limits)).cost.steps > 331


@given(
    st.lists(st.tuples(st.integers(1, 40), st.integers(1, 40)), min_size=1, max_size=12),
    st.integers(1, 60),
)
def test_the_longest_on_time_is_that_of_the_plain_search(gaps, window):
    spans, now = [], 0
    for gap, on in gaps:
        spans.append((now + gap, now + gap + on))
        now += gap + on
    plain = max(
        sum(max(0, min(e, at + window) - max(b, at)) for b, e in spans)
        for at in range(-window, now + 1)
    )
    assert longest_on(spans, window) == plain


def test_the_page_on_safety_names_every_limit():
    page = (RIGS.parents[1] / "docs" / "how-to" / "safety.md").read_text()
    assert [f for f in SafetyLimits.model_fields if f"`{f}`" not in page] == []
