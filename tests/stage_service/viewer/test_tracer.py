"""The process that models are viewed in says what this one would, and lets captures go first."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from waiting import gone, orphan, until

from stage_service.viewer import NothingToView, Source, Tracer, TracerStopped, tracer
from stage_service.viewer.operations import OPERATIONS

PARENT = """
import sys, time
from pathlib import Path
from stage_service.viewer import Source, Tracer
own = Tracer(lambda: True)
own.do(Source(Path(sys.argv[1])), "about", {}, yields=False)
own._calls[own._control] = True
with own._lock:
    own._see_to_captures()
print(own.pid, flush=True)
time.sleep(600)
"""


@pytest.fixture
def captures() -> list[bool]:
    """Whether a capture is being shot, last."""
    return [False]


@pytest.fixture
def tracing(captures) -> Iterator[Tracer]:
    made = Tracer(lambda: captures[-1])
    yield made
    made.close()


def state(pid: int | None) -> str:
    """Of a process: T where it stands still."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


def test_it_says_what_this_process_would(model, tracing):
    source = Source(model.path)
    viewed = source.open()
    for operation, options in (
        ("about", {}),
        ("strands", {"which": "model", "first": 3, "count": 20}),
        ("head", {}),
        ("lighting", {}),
        ("few", {"weights": {"3": [1.0, 0.5, 0.0]}}),
        ("environment", {"which": "studio", "rotation_deg": 30.0}),
    ):
        here = OPERATIONS[operation](viewed, **options)
        assert tracing.do(source, operation, options, yields=True) == here, operation
    with pytest.raises(NothingToView, match="light number 999"):
        tracing.do(source, "visibility", {"light": 999}, yields=True)
    with pytest.raises(RuntimeError, match="KeyError"):
        tracing.do(source, "none of them", {}, yields=True)
    assert Path(f"/proc/{tracing.pid}/stat").read_text().rpartition(")")[2].split()[16] == "19"


def test_it_stands_still_while_a_capture_is_shot(model, tracing, captures, monkeypatch):
    """Unless somebody who may steer waits for it; and goes on afterwards."""
    source, found = Source(model.path), list[Any]()
    about = tracing.do(source, "about", {}, yields=True)

    def call() -> None:
        found.append(tracing.do(source, "about", {}, yields=True))

    captures.append(True)
    thread = threading.Thread(target=call)
    thread.start()
    until(lambda: state(tracing.pid) == "T")
    assert tracing.do(source, "about", {}, yields=False) == about
    captures.append(False)
    thread.join(60)
    assert found == [about]
    captures.append(True)
    monkeypatch.setattr(tracer, "STOPPED_S", 0.0)
    with pytest.raises(TracerStopped, match="a capture is being shot"):
        tracing.do(source, "about", {}, yields=True)
    captures.append(False)
    assert tracing.do(source, "about", {}, yields=True) == about


def test_one_that_was_killed_is_started_again(model, tracing):
    source = Source(model.path)
    about, first = tracing.do(source, "about", {}, yields=True), tracing.pid
    assert first is not None
    os.kill(first, signal.SIGKILL)
    os.waitid(os.P_PID, first, os.WEXITED | os.WNOWAIT)  # every thread's, not the first's alone
    assert tracing.do(source, "about", {}, yields=True) == about
    assert tracing.pid != first


def test_it_ends_with_a_service_that_is_killed_even_while_it_stands_still(model):
    child = orphan(PARENT, model.path)
    until(lambda: gone(child))
