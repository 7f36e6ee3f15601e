"""Damaged files of every format: read or refused, and never the end of who reads them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from file_formats import FORMATS
from mutate import MOST_BYTES

CHECKOUT = Path(__file__).resolve().parents[2]


def mutated(formats: list[str], count: int, folder: Path) -> dict[str, Any]:
    """What became of so many damaged files of each format."""
    result = {}
    for name in formats:
        (folder / name).mkdir()
        command = [sys.executable, CHECKOUT / "tests/mutate.py", name, str(count)]
        done = subprocess.run(
            [*command, folder / name],
            cwd=CHECKOUT,
            env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
        )
        lines = [json.loads(x) for x in done.stdout.splitlines() if x.startswith('{"')]
        # What ended the process leaves the number of its file last.
        assert "outcomes" in lines[-1], (name, done.returncode, lines[-1], done.stderr[-500:])
        assert [x for x in lines if "wrong" in x] == [], name
        assert sum(lines[-1]["outcomes"].values()) == count
        assert lines[-1]["peak_bytes"] < MOST_BYTES, name
        result[name] = lines[-1]
    return result


def test_some_damaged_files(tmp_path):
    outcome = mutated(["journal", "frame"], 25, tmp_path)
    assert outcome["journal"]["outcomes"]["refused"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_a_thousand_damaged_files(name, tmp_path, capsys):
    found = mutated([name], 1000, tmp_path)[name]
    with capsys.disabled():
        print(f"\n{name}: {found['outcomes']}, {found['peak_bytes'] >> 20} MiB at most")
