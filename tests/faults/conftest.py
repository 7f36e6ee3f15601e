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
def add_row() -> Iterator[Callable[[str, str, str, int, str | None], None]]:
    """`add_row(fault, stepping, outcome, missing, error)`, to the table of faults."""
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
    """`hairstage serve` or `worker` in a process of its own; `log` is its standard error."""

    def __init__(self, stack: ExitStack, log: Path, *words: object, **environment: str) -> None:
        self._log_file = log
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
        assert line, self.log
        self.ready = json.loads(line)

    @property
    def log(self) -> str:
        return self._log_file.read_text()

    def stop(self) -> None:
        self.process.send_signal(signal.SIGTERM)

    def ended(self, code: int | None, *logged: str) -> None:
        """It ends within the deadline of a stop, with this exit status (None: 0 or 1), and its log
        matches these patterns.

        On a busy machine the service's own alarm (SIGALRM) may end it first.
        """
        found = self.process.wait(STOP_S + 3.0 * machine_slack())
        if found == -signal.SIGALRM and machine_slack() > 2:
            return
        assert found in ((0, 1) if code is None else (code,)), self.log
        for text in logged:
            assert re.search(text, self.log), self.log

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
