"""The end of a process that hangs: what hangs is named, and the kernel has the last word."""

from __future__ import annotations

import logging
import signal
import subprocess
import sys
import threading

from waiting import until

from stage_service.stopping import Step, end_all

ENDS = """
import logging, threading
from stage_service import stopping
logging.basicConfig()
stopping.STOP_S, stopping.LAST_S = {times}
ending = stopping.Ending({left}, {doing})
{then}
"""
WAITS = "threading.Event().wait()"
IN_NATIVE_CODE = "3 ** (10 ** 8)"  # for minutes, and no other thread runs meanwhile


def run(
    then: str = WAITS, times: tuple[float, float] = (5.0, 4.8), doing: str = "str", left: str = "[]"
) -> subprocess.CompletedProcess[str]:
    words = ENDS.format(times=times, doing=doing, left=left, then=then)
    return subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, timeout=60)


def test_a_thread_that_waits_for_ever_is_left_with_its_name():
    done = run(left="['the job database', 'the calibration']", doing="lambda: '2 requests'")
    assert done.returncode == 1
    assert "not ended: the job database; the calibration; 2 requests\n" in done.stderr


def test_threads_that_hold_nothing_are_left_without_a_word():
    then = f"threading.Thread(target=threading.Event().wait).start(); ending.by(0.1); {WAITS}"
    done = run(then, times=(60.0, 1.0))
    assert (done.returncode, done.stderr) == (0, "")


def test_native_code_that_keeps_all_threads_from_running_is_ended_by_the_kernel():
    assert run(IN_NATIVE_CODE, times=(1.0, 0.5)).returncode == -signal.SIGALRM


def test_a_step_that_fails_or_hangs_does_not_keep_the_others(caplog):
    done, stuck = threading.Event(), threading.Event()

    def fail() -> None:
        raise TimeoutError("its own")

    steps = [
        Step("first", stuck.wait, 0.1),
        Step("second", fail, 60.0),
        Step("third", done.set, 60.0),
    ]
    with caplog.at_level(logging.ERROR):
        end_all(steps, left := [])
    assert left == ["first", "second"]
    stuck.set()
    until(lambda: left == ["second"])
    assert done.is_set()
    assert [r.message for r in caplog.records] == [
        "first: not ended within 0.1 s",
        "second: its own",
    ]
    assert "TimeoutError: its own" in caplog.text
