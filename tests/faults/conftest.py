"""The table of faults and outcomes that a test run leaves in `runs/faults.md`."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
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
