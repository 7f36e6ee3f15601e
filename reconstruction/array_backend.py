"""One place that finds libLLVM, chooses Dr.Jit's back end, and says what to install."""

from __future__ import annotations

import ctypes
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

OLDEST_LLVM = 16
_PACKET = 256  # bytes: no vector of any back end is longer
_FOLDERS = ("/usr/lib", "/usr/lib64", "/usr/local/lib", "/opt/homebrew/lib")


class BackendError(RuntimeError):
    """No back end can run here; the message says what to install."""


def find_libllvm() -> str:
    """Path of the newest libLLVM of version 16 or newer.

    `DRJIT_LIBLLVM_PATH` wins when it is set. Dr.Jit 1.5 aborts the process on LLVM 15, so an older
    library is an error here, before it is imported. Raises `BackendError`.
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


def chosen_variant(variant: str | None = None) -> str:
    """The variant to run: `variant`, else `HAIRSTAGE_VARIANT`, else LLVM, which every CPU runs.

    Named as Mitsuba's are, such as `llvm_ad_rgb` or `cuda_ad_rgb`. Makes libLLVM known to Dr.Jit
    where it is needed; raises `BackendError` when it is too old or absent.
    """
    chosen = variant or os.environ.get("HAIRSTAGE_VARIANT") or "llvm_ad_rgb"
    if chosen.startswith("llvm"):
        os.environ["DRJIT_LIBLLVM_PATH"] = find_libllvm()
    return chosen


def array_types(variant: str | None = None) -> Any:
    """Dr.Jit's module of array types for the variant: `drjit.llvm` or `drjit.cuda`."""
    chosen = chosen_variant(variant)
    import drjit

    if chosen.startswith("cuda"):
        return drjit.cuda
    if chosen.startswith("llvm"):
        return drjit.llvm
    raise BackendError(
        f"the variant {chosen!r} has no arrays to compute with: choose llvm_* or cuda_* in "
        "HAIRSTAGE_VARIANT"
    )


def for_kernels(values: ArrayLike, dtype: DTypeLike = np.float32) -> NDArray[Any]:
    """A copy of `values`, of the same shape, that may be handed to a Dr.Jit array type.

    Dr.Jit reads NumPy's memory in place, and its LLVM kernels read the last packet of lanes whole:
    up to 60 bytes past the end of float32, which ends the process where the next page is not
    mapped. They are also compiled anew for memory that does not begin at a packet. The copy begins
    at one, and has room for one after its end.
    """
    values = np.asarray(values)
    size = values.size * np.dtype(dtype).itemsize
    memory = np.zeros(size + 2 * _PACKET, np.uint8)
    start = -memory.ctypes.data % _PACKET
    copy = memory[start : start + size].view(dtype).reshape(values.shape)
    copy[...] = values
    return copy
