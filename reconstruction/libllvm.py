"""Finds libLLVM for Dr.Jit, which loads it on import: import this module before.

The import raises `BackendError` if libatomic, which Mitsuba's wheel needs, is missing.
"""

from __future__ import annotations

import ctypes
import os
import re
import sys
from contextlib import suppress
from pathlib import Path

OLDEST_LLVM = 16
_FOLDERS = ("/usr/lib", "/usr/lib64", "/usr/local/lib", "/opt/homebrew/lib")


class BackendError(RuntimeError):
    """No back end can run; the message names what to install."""


def find_libllvm() -> str:
    """Path of the newest libLLVM of version 16 or newer, or of `DRJIT_LIBLLVM_PATH`.

    Raises `BackendError` for older ones, on which Dr.Jit 1.5 aborts the process.
    """
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    candidates = [Path(named)] if named else _installed()
    found = sorted(((_version(p), str(p)) for p in candidates), reverse=True)
    for version, path in found:
        if version >= OLDEST_LLVM and _loads(path):
            return path
    what = f"found only {', '.join(f'{p} (LLVM {v})' for v, p in found)}" if found else "found none"
    raise BackendError(
        f"hairstage needs libLLVM {OLDEST_LLVM} or newer and {what}: "
        "run 'apt-get install libllvm19' (or set DRJIT_LIBLLVM_PATH to the library)"
    )


def _installed() -> list[Path]:
    pattern = re.compile(r"libLLVM(-\d+)?\.so(\.\d+)*$")
    folders = [p for f in _FOLDERS for p in (Path(f), *Path(f).glob("*-linux-gnu*"))]
    folders += [p for f in _FOLDERS for p in Path(f).glob("llvm-*/lib")]
    files = (p for folder in folders if folder.is_dir() for p in folder.iterdir())
    return list({p.resolve() for p in files if pattern.match(p.name)})


def _version(path: Path) -> int:
    match = re.search(r"libLLVM[-.](?:so\.)?(\d+)", path.resolve().name)
    return int(match.group(1)) if match else 0


def _loads(path: str) -> bool:
    try:
        ctypes.CDLL(path)
    except OSError:
        return False
    return True


with suppress(BackendError):  # raised again when a back end needs it
    os.environ["DRJIT_LIBLLVM_PATH"] = find_libllvm()

if sys.platform == "linux" and not _loads("libatomic.so.1"):
    raise BackendError(
        "hairstage needs libatomic.so.1, which Mitsuba's libraries load: "
        "run 'apt-get install libatomic1'"
    )
