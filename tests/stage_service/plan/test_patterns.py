"""Patterns of lights in plans: what is lit, what it costs, what is refused before it is lit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from reconstruction.capture.light_patterns import Demultiplexing
from stage_service.config import RigFile, SafetyLimits, load_rig_file
from stage_service.device_config import LightBankConfig
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.flash import FlashRefusal
from stage_service.plan.patterns import gradients, s_matrix
from stage_service.plan.resolved import PlanError, resolve

RIGS = Path(__file__).resolve().parents[3] / "stage_service" / "rigs"
TABLE = {"half": {"light_003": 0.5, "light_007": 1.0}, "both": ["light_003", "light_009"]}
DMX = {"kind": "dmx_enttec", "port": "p", "accept_unverified_blackout": True}
COILS = {
    "kind": "modbus_rtu",
    "port": "p",
    "registers": {"levels": "none", "sequence": "none", "selector": "none"},
}


@pytest.fixture(scope="module")
def demo() -> RigFile:
    return load_rig_file(RIGS / "demo.toml")


def with_bank(rig_file: RigFile, bank: dict) -> RigFile:
    lights = TypeAdapter(LightBankConfig).validate_python(bank)
    return replace(rig_file, devices=rig_file.devices.model_copy(update={"lights": lights}))


def plan(**fields) -> CapturePlan:
    return CapturePlan(**{"patterns": TABLE, "projectors": (), "sentinels": False, **fields})


@pytest.mark.parametrize(("lights", "order"), [(3, 3), (11, 11), (23, 23), (24, 31), (156, 163)])
def test_an_s_matrix_has_the_gain_of_the_literature(lights, order):
    """Harwit and Sloane: an S-matrix of order P lights (P + 1) / 2 lamps at a time, and read noise
    is 2 √P / (P + 1) that of single lights; fewer lights than P have no more noise."""
    whole = s_matrix(order)
    assert whole.shape == (order, order)
    assert set(whole.sum(axis=1)) == {(order + 1) / 2}
    expected = 2 * np.sqrt(order) / (order + 1)
    np.testing.assert_allclose(Demultiplexing(whole).read_gain, expected)
    some = s_matrix(lights)
    np.testing.assert_array_equal(some, whole[:, :lights])
    gain = Demultiplexing(some).read_gain
    assert gain.max() <= expected + 1e-9
    assert gain.min() > 0.8 * expected


def test_gradients_follow_the_direction_of_the_light(demo):
    """Of a light 1.2 m in front of the face (−y) and above, at 45°: y is (1 − √½) / 2."""
    light = replace(demo.rig.lights[0], position=np.array([0.0, -0.85, 0.85]))
    rig = replace(demo.rig, lights=(light, *demo.rig.lights[1:]))
    made = gradients(rig, [x.name for x in rig.lights])
    of = dict(zip(made.names, made.weights, strict=True))
    low, high = (1 - np.sqrt(0.5)) / 2, (1 + np.sqrt(0.5)) / 2
    assert [of[k][0] for k in ("full", "x", "y", "z")] == pytest.approx([1, 0.5, low, high])
    for axis in "xyz":
        np.testing.assert_allclose(of[axis] + of[f"{axis}_inverse"], of["full"])


def test_steps_are_the_patterns_in_their_order_and_no_single_light(demo):
    found = resolve(plan(brackets=(1.0, 0.5), lit_every=1, exposure={"pattern": 0.01}), demo)
    steps = [(s.kind, s.pattern, s.exposure) for s in found.steps if s.kind != "all_on"]
    assert steps == [
        ("pattern", "half", 0.01),
        ("pattern", "both", 0.01),
        ("pattern", "half", 0.005),
        ("pattern", "both", 0.005),
    ]
    assert [s.kind for s in found.steps[:3]] == ["all_on", "pattern", "all_on"]
    assert found.cost.frames_by_kind["pattern"] == 4 * len(demo.rig.cameras)
    levels = found.lamp_levels(found.steps[1])
    assert {i: levels[i] for i in np.flatnonzero(levels)} == pytest.approx(
        {3: 0.5 * found.steps[1].level, 7: found.steps[1].level}, abs=1e-5
    )
    made = resolve(CapturePlan(patterns="s_matrix", lights=("light_002", "light_000")), demo)
    assert [s.pattern for s in made.steps if s.kind == "pattern"] == ["s_000", "s_001", "s_002"]
    assert made.patterns.lights == ("light_002", "light_000")


def test_the_capture_records_the_light_that_a_bank_of_few_levels_makes(demo):
    """DMX has n / 255: level 0.02 is 5 / 255, of which 0.5 and 0.33 are 2 and 2."""
    table = {"a": {"light_000": 1.0, "light_001": 0.5, "light_002": 0.33, "light_003": 0.05}}
    found = resolve(plan(patterns=table, level={"pattern": 0.02}), with_bank(demo, DMX))
    (step,) = found.steps
    assert step.level == 5 / 255
    recorded = found.recorded_patterns["patterns"]
    assert dict(zip(recorded["lights"], recorded["weights"]["a"], strict=True)) == pytest.approx(
        {"light_000": 1.0, "light_001": 0.4, "light_002": 0.4, "light_003": 0.0}
    )
    words = 255 * found.lamp_levels(step)[:4]
    np.testing.assert_allclose(words, [5, 2, 2, 0])


def test_light_adds_up_over_all_lamps_of_a_pattern(demo):
    """Dose and lamp seconds of a pattern are those of its lights alone, by weight."""
    only = resolve(plan(patterns={"p": TABLE["half"]}, level={"pattern": 0.5}), demo).cost
    alone = [
        resolve(CapturePlan(lights=(x,), projectors=(), sentinels=False), demo).cost
        for x in ("light_003", "light_007")
    ]
    for field in ("dose", "lamp_seconds"):
        first, second = (np.array(getattr(cost, field)) for cost in alone)
        expected = 0.5 * (0.5 * first + second)
        np.testing.assert_allclose(getattr(only, field), expected, rtol=1e-4)


@pytest.mark.parametrize(
    ("limits", "fields", "problem"),
    [
        (
            {"max_lamps": 100},
            {"patterns": "s_matrix"},
            "pattern: 166 lamps would be lit at once; [safety] max_lamps allows 100: light fewer",
        ),
        (
            {"max_power_w": 14.0},
            {"level": {"pattern": 1.0}},
            "level.pattern: 2 lamps of half at level 1 draw 15 W; [safety] max_power_w allows 14 W",
        ),
        (
            {"max_on_s": 1.0},
            {"exposure": {"pattern": 2.0}},
            "exposure.pattern: step 0 has a lamp lit for 2",
        ),
        (
            {"max_duty": 0.01, "duty_window_s": 10.0},
            {"exposure": {"pattern": 0.06}},
            "lamp light_003 would be lit 0.1",  # in both patterns; the others in one, 0.06 s
        ),
    ],
)
def test_a_limit_counts_every_lamp_of_a_pattern(demo, limits, fields, problem):
    if "max_power_w" in limits:
        fields = fields | {"patterns": {"half": TABLE["half"]}}
    with pytest.raises(PlanError) as error:
        resolve(plan(**fields), replace(demo, safety=SafetyLimits(**limits)))
    (found,) = error.value.problems
    assert problem in found


@pytest.mark.parametrize(
    ("bank", "fields", "problem"),
    [
        (
            COILS,
            {"level": {"pattern": 1.0}},
            "half has weights between 0 and 1, and the light bank",
        ),
        (COILS, {"patterns": "s_matrix"}, "has no levels: its lamps are at 1, not at 0.04"),
        (COILS, {"patterns": "s_matrix", "level": {"pattern": 1.0}}, None),
        (DMX, {"level": {"pattern": 0.001}}, "so that 0.001 would be dark: use one above 0.00196"),
        (
            DMX,
            {"patterns": {"dim": {"light_000": 0.1}}, "level": {"pattern": 0.004}},
            "patterns: dim would be dark at level 0.004: raise level.pattern",
        ),
        (None, {"patterns": {"p": ["lamp"]}}, "patterns: there is no light 'lamp'; its 331 are"),
        (None, {"lights": ("light_003", "light_007")}, "light 'light_009', which 'lights' excl"),
        (None, {"patterns": "gradients", "lights": ()}, "patterns: the plan has no lights"),
        (
            None,
            {"patterns": {"p": {"light_000": 0.0}, "q": ["light_001"]}},
            "pattern p lights nothing",
        ),
        (None, {"patterns": {"light_000": ["light_001"]}}, "a file's name that no light has"),
    ],
)
def test_a_pattern_that_the_stage_cannot_show_is_refused(demo, bank, fields, problem):
    rig_file = demo if bank is None else with_bank(demo, bank)
    if problem is None:
        resolve(plan(**fields), rig_file)
        return
    with pytest.raises(PlanError) as error:
        resolve(plan(**fields), rig_file)
    assert len(error.value.problems) == 1
    assert problem in error.value.problems[0]


def test_weights_beyond_0_to_1_are_no_plan():
    with pytest.raises(ValidationError, match="less than or equal to 1"):
        plan(patterns={"p": {"light_000": 1.1}})


def test_the_trigger_box_steps_no_patterns(demo):
    """An entry of the bank's table has one lamp or all (docs/reference/wire.md)."""
    devices = demo.devices.model_copy(update={"hardware_stepping": True})
    wired = replace(demo, devices=devices)
    cost = resolve(plan(patterns="s_matrix"), wired).cost
    assert cost.stepping["hardware"] == 0
    assert "one lamp or all, so the service lights patterns" in cost.stepping_why
    with pytest.raises(PlanError, match="no pattern: let the service step"):
        resolve(plan(stepping="hardware"), wired)


@pytest.mark.parametrize(
    ("exposure", "rate_hz", "hz"), [(0.02, 25.0, 25.0), (0.001, 100.0, 25.0), (0.02, 2.5, None)]
)
def test_fast_patterns_of_uneven_brightness_need_consent(demo, exposure, rate_hz, hz):
    """At 100 Hz every fourth pattern may be the bright one: it flashes at 25 Hz."""
    link = {"readout_s": 0.0, "bytes_per_s": 1e15}
    cameras = demo.devices.cameras.model_copy(update=link)
    fast = replace(
        demo,
        devices=demo.devices.model_copy(update={"cameras": cameras}),
        safety=SafetyLimits(living_subject=True),
        capture=demo.capture.model_copy(update={"storage_bytes_per_s": 1e15}),
    )
    found = resolve(
        plan(patterns="s_matrix", rate_hz=rate_hz, exposure={"pattern": exposure}), fast
    )
    flash = found.cost.flash
    assert flash.needs_consent == (hz is not None)
    if hz is not None:
        assert flash.hz == pytest.approx(hz, rel=0.02)
        with pytest.raises(FlashRefusal, match="within 3 to 30 Hz"):
            found.check_flashing(None)
