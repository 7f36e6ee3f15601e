"""A Chromium for benchmarks, and the processor time that it takes."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.command import LeftOut

TICK_S = 1 / os.sysconf("SC_CLK_TCK")


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    """`launch(*arguments)` starts a browser, which ends with the block. Raises `LeftOut`."""
    path = shutil.which("chromium") or shutil.which("google-chrome")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise LeftOut("Playwright is not installed: pip install 'hairstage[test]'") from error
    if path is None:
        raise LeftOut("there is no Chromium here")
    with sync_playwright() as playwright:
        yield lambda *arguments: playwright.chromium.launch(
            executable_path=path, args=["--no-sandbox", *arguments]
        )


def cpu_s(pid: int) -> float:
    """User and system seconds of a process and of its children that have ended."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) * TICK_S


def browser_cpu_s() -> float:
    """That of all processes that this one has begun which are a browser's."""
    found, parents = 0.0, {os.getpid()}
    known: dict[int, tuple[int, str]] = {}
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            text = (process / "stat").read_text()
            known[int(process.name)] = (int(text.rpartition(")")[2].split()[1]), text)
    while more := {pid for pid, (parent, _) in known.items() if parent in parents} - parents:
        parents |= more
    for pid in parents - {os.getpid()}:
        if "chrom" in known[pid][1].partition("(")[2].partition(")")[0]:
            with contextlib.suppress(OSError):
                found += cpu_s(pid)
    return found
