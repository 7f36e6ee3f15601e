"""The clock of the tests: how long a device may take on a machine that does other things, too."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import pytest

from simulators.peers.faults import Fault, Faults

T = TypeVar("T")


def machine_slack() -> int:
    """How many times longer than on an idle machine a deadline has to be: 1 where it is idle.

    The number of runnable threads for each core, now or over the last minute.
    HAIRSTAGE_TEST_SLACK, where it is set, says it instead.
    """
    if said := os.environ.get("HAIRSTAGE_TEST_SLACK"):
        return int(said)
    average, _, _, threads, _ = Path("/proc/loadavg").read_text().split()
    running = max(float(average), float(threads.split("/")[0]))
    return max(1, math.ceil(running / len(os.sched_getaffinity(0))))


def slowed(faults: tuple[Fault, ...], slack: int) -> Faults:
    """Faults whose lateness has grown as the deadlines have."""
    return Faults(tuple(replace(f, seconds=min(f.seconds * slack, 60.0)) for f in faults))


def until(what: Callable[[], T], seconds: float | None = None, *, pause: float = 0.002) -> T:
    """Poll for what another thread or process brings about; what `what` returns once it is true.

    `seconds` only where the deadline is what is tested, and then times `slack`. `pause` seconds
    between looks: more where a look costs the process that is waited for.
    """
    seconds = 60.0 * machine_slack() if seconds is None else seconds
    began = looked = time.monotonic()
    while not (found := what()):
        now = time.monotonic()
        assert now < began + seconds, f"it did not happen within {seconds:g} s"
        # A look that costs a request is followed by a longer pause: it takes the other's core.
        time.sleep(max(pause, min(3 * (now - looked), 0.1)))
        looked = time.monotonic()
    return found


def gone(pid: int) -> bool:
    """Whether that process has ended, whoever has still to take note of it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except OSError:
        return True


def orphan(code: str, folder: Path) -> int:
    """A process that `code`, run on `folder`, has started, whose number it prints, and is killed
    then. Skips where children are not tied."""
    if shutil.which("setpriv") is None:
        pytest.skip("there is no setpriv here: children outlive a service that is killed")
    words = [sys.executable, "-c", code, folder]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as service:
        assert service.stdout is not None
        child = int(service.stdout.readline())
        service.kill()
    return child
