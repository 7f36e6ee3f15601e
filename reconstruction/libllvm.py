"""Finds libLLVM and names it to Dr.Jit, which loads it as it is imported: import this before.

The import raises `BackendError` where libatomic is missing, without which Mitsuba's wheel cannot
be imported.
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
    """No back end can run here; the message says what to install."""


def find_libllvm() -> str:
    """Path of the newest libLLVM of version 16 or newer.

    `DRJIT_LIBLLVM_PATH` wins when it is set. Dr.Jit 1.5 aborts the process on LLVM 15, so an older
    library is an error here. Raises `BackendError`.
    """
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    candidates = [Path(named)] if named else _installed()
    found = sorted(((_version(p), str(p)) for p in candidates), reverse=True)
    for version, path in found:
        if version >= OLDEST_LLVM and _loads(path):
            return path
    seen = f"found only {', '.join(f'{p} (LLVM {v})' for v, p in found)}" if found else "found none"
    raise BackendError(
        f"hairstage needs libLLVM {OLDEST_LLVM} or newer and {seen}: "
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


with suppress(BackendError):  # whoever asks for a back end that needs it is told
    os.environ["DRJIT_LIBLLVM_PATH"] = find_libllvm()

if sys.platform == "linux" and not _loads("libatomic.so.1"):
    raise BackendError(
        "hairstage needs libatomic.so.1, which Mitsuba's libraries load: "
        "run 'apt-get install libatomic1'"
    )
