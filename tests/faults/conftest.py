"""Services in processes of their own, and the table of faults that a run leaves in
`runs/faults.md`."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import httpx
import pytest
from waiting import machine_slack

from stage_service.stopping import STOP_S

CHECKOUT = Path(__file__).resolve().parents[2]
STANDING = ("-m", "benchmarks.service.standing_service")
HEADER = (
    "# Faults and what became of them\n\n"
    "Written by `tests/faults`. After each: every lamp and projector off, every frame of the "
    "journal whole and in its place.\n\n"
    "| fault | who clocks | outcome | frames missing | what the operator reads |\n"
    "|---|---|---|---|---|\n"
)


@pytest.fixture(scope="session")
def told() -> Iterator[Callable[[str, str, str, int, str | None], None]]:
    """`told(fault, stepping, outcome, missing, error)` adds a row to the table."""
    rows: list[str] = []

    def add(fault: str, stepping: str, outcome: str, missing: int, error: str | None) -> None:
        text = re.sub(r"/\S*/(small\d+|state)/|:\d{5}\b", "", error or "")
        text = text.replace("|", "\\|").replace("\n", " ")
        rows.append(f"| {fault} | {stepping} | {outcome} | {missing} | {text} |\n")

    yield add
    if rows:
        (CHECKOUT / "runs").mkdir(exist_ok=True)
        (CHECKOUT / "runs" / "faults.md").write_text(HEADER + "".join(sorted(rows)))


class Process:
    """`hairstage serve` or `worker` in a process of its own; `told` is what it has logged."""

    def __init__(self, stack: ExitStack, log: Path, *words: object, **environment: str) -> None:
        self._log = log
        path = {"PYTHONPATH": f"{CHECKOUT}:{CHECKOUT / 'tests'}"}
        with log.open("w") as stderr:
            self.process = subprocess.Popen(
                [sys.executable, *map(str, words)],
                stdout=subprocess.PIPE,
                stderr=stderr,
                text=True,
                env={**os.environ, **path, **environment},
            )
        stack.callback(self._kill)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, self.told
        self.ready = json.loads(line)

    @property
    def told(self) -> str:
        return self._log.read_text()

    def stop(self) -> None:
        self.process.send_signal(signal.SIGTERM)

    def ended(self, code: int | None, *told: str) -> None:
        """It ends within what a stop takes at most, with this exit status (None: 0 or 1) and
        these words last.

        A machine on which it cannot even say that leaves the end to the kernel.
        """
        found = self.process.wait(STOP_S + 3.0 * machine_slack())
        if found == -signal.SIGALRM and machine_slack() > 2:
            return
        assert found in ((0, 1) if code is None else (code,)), self.told
        for text in told:
            assert re.search(text, self.told), self.told

    def _kill(self) -> None:
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as one:
        yield one


@pytest.fixture
def process(stack) -> Callable[..., Process]:
    """`process(log, *words, **environment)`: a Python program that prints JSON when it is ready."""
    return partial(Process, stack)


@pytest.fixture
def serve(process, stack, tmp_path):
    """`serve(rig_file, standing=(place, call), **environment)`: a service and its client."""

    def start(rig_file, standing=None, **environment):
        words = ["serve", "--json", "--no-auth", "--port", "0", "--rig", rig_file.path]
        words += ["--devices", rig_file.path.with_suffix("") / "devices.toml"]
        words += ["--root", tmp_path / "root"]
        program = ("-m", "stage_service.cli")
        if standing is not None:
            program = (*STANDING, tmp_path, *standing)
        service = process(tmp_path / "serve.log", *program, *words, **environment)
        client = httpx.Client(base_url=service.ready["url"], timeout=60, trust_env=False)
        return service, stack.enter_context(client)

    return start
