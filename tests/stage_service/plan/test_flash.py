"""How fast a plan flashes, as planned and as measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from pydantic import ValidationError

from reconstruction import Step
from stage_service.acquisition.exposing import FlashWatch
from stage_service.config import RigFile, SafetyLimits, load_rig_file
from stage_service.devices.errors import SafetyRefusal
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.flash import flash_rate
from stage_service.plan.resolved import resolve
from stage_service.plan.timeline import Lit

RIGS = Path(__file__).resolve().parents[3] / "stage_service" / "rigs"


@pytest.fixture(scope="module")
def living() -> RigFile:
    demo = load_rig_file(RIGS / "demo.toml")
    assert not demo.safety.living_subject, "the demonstration's subject is simulated"
    return replace(demo, safety=SafetyLimits())


def test_a_rig_file_that_says_nothing_stands_before_a_living_subject():
    assert load_rig_file(RIGS / "stage331.toml").safety.living_subject


def lights(period: float, count: int = 30, every: int = 0) -> list[Lit]:
    """Scanlines so many seconds apart; every so many, the step is a tracking frame."""
    kinds = ["tracking" if every and i % every == 0 else "scanline" for i in range(count)]
    return [Lit(Step(i, k, 0.001), i * period, 0.001) for i, k in enumerate(kinds)]


@pytest.mark.parametrize(
    ("hz", "band"),
    [
        (0.5, "below 3 Hz"),
        (2.99, "below 3 Hz"),
        (3.0, "3 to 30 Hz"),
        (16.0, "3 to 30 Hz"),
        (30.0, "3 to 30 Hz"),
        (30.1, "above 30 Hz"),
        (500.0, "above 30 Hz"),
    ],
)
def test_the_bands_and_their_edges(hz, band):
    rate = flash_rate(lights(1 / hz), living_subject=True)
    assert (rate.band, rate.needs_consent) == (band, band == "3 to 30 Hz")
    assert rate.hz == pytest.approx(hz)
    assert not flash_rate(lights(1 / hz), living_subject=False).needs_consent


def test_up_to_three_flashes_in_a_second_are_no_flashing():
    assert flash_rate(lights(0.1, count=3), living_subject=True).band == "below 3 Hz"
    assert flash_rate(lights(0.1, count=4), living_subject=True).band == "3 to 30 Hz"
    assert flash_rate([], living_subject=True).hz == 0.0


def test_tracking_frames_flash_at_their_own_rate():
    fast = flash_rate(lights(1 / 100), living_subject=True)
    assert fast.band == "above 30 Hz"
    tracked = flash_rate(lights(1 / 100, count=60, every=10), living_subject=True)
    assert (tracked.band, tracked.needs_consent) == ("3 to 30 Hz", True)
    assert tracked.hz == pytest.approx(10.0)
    assert tracked.by_kind["tracking"] == pytest.approx(10.0)
    slow = flash_rate(lights(1 / 100, count=200, every=50), living_subject=True)
    assert slow.band == "above 30 Hz"


def test_a_plan_is_classified_by_what_it_predicts(living):
    plan = CapturePlan(projectors=(), stepping="software")
    cost = resolve(plan, living).cost
    per_step = cost.seconds / cost.steps
    assert cost.flash.by_kind["olat"] == pytest.approx(1 / per_step, rel=0.05)
    slow = resolve(plan.model_copy(update={"rate_hz": 2.5}), living).cost
    assert (slow.flash.band, slow.flash.needs_consent) == ("below 3 Hz", False)
    assert slow.flash.hz == pytest.approx(2.5)
    assert slow.seconds >= slow.steps / 2.5


def test_a_plan_in_the_band_needs_consent_before_a_living_subject_only(living):
    plan = CapturePlan(projectors=(), exposure={"olat": 0.08}, stepping="software", rate_hz=5.0)
    assert resolve(plan, living).cost.flash.needs_consent
    puppet = replace(living, safety=SafetyLimits(living_subject=False))
    assert not resolve(plan, puppet).cost.flash.needs_consent
    with pytest.raises(ValidationError):
        CapturePlan(consent="yes")


def test_steps_of_the_trigger_box_are_classified_by_its_period(living):
    assert living.devices is not None
    wired = living.devices.model_copy(update={"hardware_stepping": True})
    rig_file = replace(living, devices=wired)
    plan = CapturePlan(projectors=(), sentinels=False, exposure={"olat": 0.004}, rate_hz=20.0)
    cost = resolve(plan, rig_file).cost
    assert cost.stepping["hardware"] > 300
    assert cost.flash.hz == pytest.approx(20.0)


def test_the_watch_stops_before_the_fourth_flash_in_the_band():
    now = [0.0]
    watch = FlashWatch(lambda: now[0])
    step = Step(5, "olat", 0.01, light="light_005")
    for _ in range(3):
        watch(step)
        now[0] += 0.1
    with pytest.raises(SafetyRefusal, match=r"step 5 \(olat\).*10\.0 Hz.*rate_hz to 2\.5"):
        watch(step)


def test_the_watch_lets_slow_and_fast_flashes_pass_and_forgives_a_hiccup():
    now = [0.0]
    watch = FlashWatch(lambda: now[0])
    step, dark = Step(5, "olat", 0.01, light="light_005"), Step(0, "dark", 0.01)
    for seconds in [0.4] * 20 + ([0.01] * 99 + [0.2]) * 5 + [0.05, 0.05]:
        watch(step)
        watch(dark)
        now[0] += seconds
    with pytest.raises(SafetyRefusal, match=r"10\.0 Hz"):  # what was fast has become slower
        watch(step)
