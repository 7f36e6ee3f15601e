"""Signals that come inside Dr.Jit's loops."""

import os
import signal

import pytest

from appearance.scene.backend import ensure_backend
from stage_service.signals import Terminated, terminable


def test_a_stop_inside_a_loop_of_drjit_is_a_stop() -> None:
    """Dr.Jit wraps what is raised in a loop: the command called it a fault of hairstage."""
    ensure_backend()
    import drjit as dr
    import mitsuba as mi

    def body(i: object) -> tuple[object]:
        os.kill(os.getpid(), signal.SIGTERM)
        return (i + 1,)  # type: ignore[operator]

    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)  # other tests start services here
    try:
        with pytest.raises(Terminated), terminable():
            dr.while_loop((dr.zeros(mi.UInt32, 4),), lambda i: i < 3, body)
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_fault_with_a_cause_stays_itself() -> None:
    with pytest.raises(RuntimeError, match="outer"), terminable():
        raise RuntimeError("outer") from ValueError("inner")
