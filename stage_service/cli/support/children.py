"""Child processes that end with the command that started them."""

from __future__ import annotations

import contextlib
import json
import select
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from stage_service.cli.support.commands import BAD_INPUT, UNREACHABLE, CommandError
from stage_service.signals import held, tied

GRACE_S = 20.0
"""Seconds that a child has to end by itself; the service puts the lights off in that time."""


class Children:
    """Starts processes and ends them on every exit of its with-block, the latest first.

    Each child's output goes to `logs/<name>.log`. Children are `tied`: the thread that starts them
    must outlive them.
    """

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._running: list[tuple[str, subprocess.Popen[str]]] = []

    def __enter__(self) -> Self:
        self._logs.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(self, *_: object) -> None:
        # a second Ctrl-C must not leave lamps on
        before = {n: signal.signal(n, signal.SIG_IGN) for n in (signal.SIGINT, signal.SIGTERM)}
        try:
            for _name, child in reversed(self._running):
                end(child)
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def start(
        self, name: str, command: list[str], *, to_log: bool = True, pipe: bool = False
    ) -> subprocess.Popen[str]:
        """Start a child in its own process group, which Ctrl-C does not reach.

        With `pipe` its stdout is a pipe, for `first_line`.
        """
        with contextlib.ExitStack() as stack:
            # a Ctrl-C between start and entry would leave a child that is never ended
            stack.enter_context(held(signal.SIGINT, signal.SIGTERM))
            log = stack.enter_context(self.log(name).open("a")) if to_log else None
            child = subprocess.Popen(
                tied(command),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE if pipe else log,
                stderr=log,
                text=True,
                start_new_session=True,
            )
            self._running.append((name, child))
        return child

    def log(self, name: str) -> Path:
        """The child's log file."""
        return self._logs / f"{name}.log"

    def first_line(self, name: str, child: subprocess.Popen[str], seconds: float) -> dict[str, Any]:
        """The JSON object that the child prints when it is ready."""
        assert child.stdout is not None
        readable, _, _ = select.select([child.stdout], [], [], seconds)
        line = child.stdout.readline() if readable else ""
        if not line:
            if readable:  # the pipe was closed: the process is about to end
                child.wait(GRACE_S)
            raise self._not_ready(name, child, seconds)
        message: dict[str, Any] = json.loads(line)
        return message

    def ready(self, name: str, command: list[str], seconds: float) -> dict[str, Any]:
        """Start a child; returns the JSON object that it prints when it is ready."""
        return self.first_line(name, self.start(name, command, pipe=True), seconds)

    def check(self) -> None:
        """Raise `CommandError` when a child has ended by itself."""
        for name, child in self._running:
            if child.poll() is not None:
                raise CommandError(
                    f"{name} ended with exit code {child.returncode}; {self._last_line(name)}",
                    UNREACHABLE,
                )

    def _not_ready(self, name: str, child: subprocess.Popen[str], seconds: float) -> CommandError:
        code = child.poll()
        what = f"ended with exit code {code}" if code is not None else f"not ready in {seconds} s"
        why = BAD_INPUT if code in (2, 3) else UNREACHABLE
        return CommandError(f"{name}: {what}; {self._last_line(name)}", why)

    def _last_line(self, name: str) -> str:
        log = self.log(name)
        if not log.is_file():
            return "see its output above"
        lines = log.read_text(errors="replace").strip().splitlines()
        return f"the last line of {log}: {lines[-1] if lines else '(empty)'}"


def end(child: subprocess.Popen[str]) -> None:
    """End a child: SIGTERM, after `GRACE_S` SIGKILL."""
    if child.poll() is None:
        child.terminate()
        try:
            child.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
    if child.stdout is not None:
        child.stdout.close()


def own_command(*arguments: str | Path) -> list[str]:
    """A command line that runs `hairstage` with this Python."""
    return [sys.executable, "-m", "stage_service.cli", *map(str, arguments)]


@dataclass(frozen=True)
class SimulatedRig:
    """A rig file and its subject: a name, or a strand file with its head."""

    rig: Path
    subject: str = "wavy"
    head: Path | str | None = None
    seed: int = 0

    def command(self, *more: str | Path) -> list[str]:
        """The simulators' command line."""
        words = [sys.executable, "-m", "simulators", "--rig", self.rig, "--subject", self.subject]
        words += ["--seed", self.seed, *(["--head", self.head] if self.head is not None else [])]
        return [str(word) for word in (*words, *more)]
