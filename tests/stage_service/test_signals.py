"""A signal ends the wait whenever it comes; others do not."""

from __future__ import annotations

import subprocess
import sys

WAITS = """
import signal, threading
from stage_service.signals import taken
signal.signal(signal.SIGUSR1, lambda *_: None)
wait = taken(signal.SIGTERM, signal.SIGINT)
signal.raise_signal(signal.SIGUSR1)
{before}
wait()
print("over")
"""


def run(before: str) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-c", WAITS.format(before=before)]
    return subprocess.run(words, capture_output=True, text=True, timeout=20)


def test_a_signal_that_comes_before_the_wait_is_not_slept_through():
    done = run("signal.raise_signal(signal.SIGTERM)")
    assert (done.returncode, done.stdout) == (0, "over\n"), done.stderr


def test_a_signal_amid_the_wait_ends_it_and_another_does_not():
    later = "threading.Timer(0.2, lambda: signal.raise_signal(signal.SIGINT)).start()"
    done = run(later)
    assert (done.returncode, done.stdout) == (0, "over\n"), done.stderr
