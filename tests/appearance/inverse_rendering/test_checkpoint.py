"""A fit's state in one file: whole on the disk, or the one before it."""

import numpy as np
import pytest

from appearance.inverse_rendering.checkpoint import State
from appearance.metrics.decision import Decision
from reconstruction.files import durable


def state(value: float) -> State:
    raw = {"beta_m": np.array([value])}
    return State(raw, np.ones(2), [Decision("shared", value, 0.5, 0.1)])


def test_a_state_is_on_the_disk_before_it_replaces_the_one_before_it(tmp_path, monkeypatch):
    file = tmp_path / "fit.checkpoint.npz"
    state(1.0).save(file, "a")

    def full(path):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(durable, "flush", full)
    with pytest.raises(OSError, match="No space left"):
        state(2.0).save(file, "a")
    assert list(tmp_path.iterdir()) == [file]
    found = State.load(file, "a")
    assert found.raw["beta_m"] == 1.0
    assert found.gain.tolist() == [1.0, 1.0]
    assert found.decisions == [Decision("shared", 1.0, 0.5, 0.1)]
    assert State.load(file, "b") is None
