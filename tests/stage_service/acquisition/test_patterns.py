"""Patterns of lights over the simulators' wires: what the frames hold, and that all ends dark."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from waiting import until

from reconstruction import Capture, CaptureError, CaptureWriter, verify
from reconstruction.capture.demultiplexing import demultiplex
from simulators.peers.faults import Fault
from stage_service.acquisition.sequencer import Sequencer
from stage_service.config import RigFile
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.permission import Permission
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.resolved import resolve

TRUTH = 0.1 * np.arange(1, 25)
"""W/(sr m²) of each lamp of the simulated stage at full level, in every pixel."""
EXPOSURE_S = 0.002
COUNTS = EXPOSURE_S * 50_000.0
"""Counts for 1 W/(sr m²) of the simulated sensor; 2.48 electrons a count, 4 of read noise."""
DMX = """[devices.lights]
kind = "sacn"
host = "node"
accept_unverified_blackout = true"""


def sequencer(rig_file: RigFile, path, **plan) -> Sequencer:
    fields = {
        "projectors": (),
        "sentinels": False,
        "level": {"pattern": 1.0},
        "exposure": {"pattern": EXPOSURE_S},
        **plan,
    }
    wanted = resolve(CapturePlan(**fields), rig_file)
    described = {"steps": wanted.steps, **wanted.recorded_patterns}
    writer = CaptureWriter.create(path, rig_file.rig, described)
    permission = Permission.granted("a test")
    return Sequencer(DeviceSet.of(rig_file), writer, wanted, permission=permission)


def shot(rig_file: RigFile, path, **plan) -> Capture:
    run = sequencer(rig_file, path, **plan)
    assert run.run() == "completed", run.error
    assert verify(path) == []
    return Capture(path)


def noise(radiance):
    """Deviation of one pixel of a frame, W/(sr m²): of photons, reading and rounding."""
    electrons = radiance * COUNTS * 2.48
    return np.sqrt((electrons + 4.0**2) / 2.48**2 + 1 / 12) / COUNTS


def test_an_s_matrix_gives_the_single_lights_with_the_predicted_noise(simulated, tmp_path):
    rig_file, world = simulated()
    single = shot(rig_file, tmp_path / "single")
    patterns = shot(rig_file, tmp_path / "patterns", patterns="s_matrix")
    assert not world.lamps.power().any()
    assert len(patterns.steps) == 31  # for 24 lights
    made = demultiplex(patterns, tmp_path / "made")
    assert made.misfit is not None
    assert made.capture.olat_lights() == single.olat_lights()
    pixels = 2 * 16 * 12 * 3
    sums = patterns.patterns.weights @ TRUTH
    expected = np.sqrt(np.square(made.solution.matrix) @ np.square(noise(sums)))
    ratios = []
    for name, truth, predicted in zip(single.olat_lights(), TRUTH, expected, strict=True):
        alone, solved = (
            np.concatenate([c.light(name, x.name)[0].ravel() for x in c.rig.cameras])
            for c in (single, made.capture)
        )
        assert alone.mean() == pytest.approx(truth, abs=5 * noise(truth) / np.sqrt(pixels))
        assert solved.mean() == pytest.approx(truth, abs=5 * predicted / np.sqrt(pixels))
        ratios.append((alone.std() / noise(truth), solved.std() / predicted))
    # 1152 pixels give a deviation within 2 %
    np.testing.assert_allclose(ratios, 1.0, atol=0.1)
    # of reading alone, it falls to 2 √31 / 32
    assert made.solution.read_gain.max() <= 2 * np.sqrt(31) / 32


def test_patterns_that_saturate_every_pixel_are_not_demultiplexed(simulated, tmp_path):
    rig_file, _ = simulated()
    shot(rig_file, tmp_path / "c", patterns="s_matrix", exposure={"pattern": 0.02})
    with pytest.raises(CaptureError, match="every pixel of cam_a is saturated under a pattern"):
        demultiplex(Capture(tmp_path / "c"), tmp_path / "made")


def test_gradients_over_a_bank_of_255_levels_hold_the_recorded_sums(simulated, small_rig, tmp_path):
    rig_file, world = simulated(rig=small_rig.replace("[devices.lights]", DMX))
    capture = shot(rig_file, tmp_path / "c", patterns="gradients", level={"pattern": 0.1})
    assert not world.lamps.power().any()
    assert [s.level for s in capture.steps] == [26 / 255] * 7
    weights = capture.patterns.weights
    np.testing.assert_allclose(weights * 26, np.round(weights * 26), atol=1e-9)
    for name, expected in zip(capture.patterns.names, weights @ TRUTH, strict=True):
        image, _ = capture.light(name, "cam_a")
        error = noise(26 / 255 * expected) * 255 / 26
        assert image.mean() == pytest.approx(expected, abs=5 * error / np.sqrt(16 * 12 * 3))


def test_a_bank_that_puts_lamps_of_a_pattern_off_fails_the_capture(simulated, tmp_path):
    rig_file, _ = simulated(Fault("lights", "lies", pulse=3))
    run = sequencer(
        rig_file,
        tmp_path / "c",
        patterns={"p": ["light_000", "light_005"]},
        brackets=(1.0, 2.0, 3.0, 4.0),
    )
    assert run.run() == "failed"
    assert "expected 2 lamps lit, received 0 lit" in run.error


def test_a_blackout_during_a_pattern_is_dark(simulated, tmp_path):
    rig_file, world = simulated()
    run = sequencer(
        rig_file, tmp_path / "c", patterns="gradients", exposure={"pattern": 5.0}, retries=0
    )
    thread = threading.Thread(target=run.run)
    thread.start()
    assert until(lambda: np.count_nonzero(world.lamps.power()) == 24)
    dark = run.darken(10.0)
    assert dark.safe
    assert not world.lamps.power().any()
    thread.join()
    assert run.outcome == "aborted"
    assert not world.lamps.power().any()
