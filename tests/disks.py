"""A disk that is really full, or read-only: a file system of 40 MB in a name space of its own."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

MOUNT = 'mount -t tmpfs -o size=40m tmpfs "$0" && exec "$@"'


def on_small_disk(folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """Run a command that finds the small disk at `folder`."""
    return subprocess.run(
        ["unshare", "--map-root-user", "--mount", "sh", "-c", MOUNT, str(folder), *command],
        capture_output=True,
        text=True,
        check=False,
    )


def require_small_disk(folder: Path) -> None:
    """Skip the test where this machine allows none."""
    try:
        possible = on_small_disk(folder, "true")
    except FileNotFoundError as error:
        pytest.skip(f"no file system of our own: {error}")
    if possible.returncode:
        pytest.skip(f"no file system of our own: {possible.stderr.strip()}")
