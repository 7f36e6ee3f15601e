"""The choice of Dr.Jit's back end, and NumPy arrays for it."""

from __future__ import annotations

import os
from typing import Any

from reconstruction.libllvm import BackendError, find_libllvm

# isort: split
import drjit
import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

VARIANT = "HAIRSTAGE_VARIANT"
"""The environment variable that names the variant."""

_PACKET = 256  # bytes: no vector of any back end is longer


def chosen_variant(variant: str | None = None) -> str:
    """The variant to run: `variant`, else `HAIRSTAGE_VARIANT`, else LLVM.

    Mitsuba's names, such as `llvm_ad_rgb` or `cuda_ad_rgb`. Raises `BackendError` if libLLVM is too
    old or missing, or without a GPU.
    """
    chosen = variant or os.environ.get(VARIANT) or "llvm_ad_rgb"
    if chosen.startswith("llvm"):
        os.environ["DRJIT_LIBLLVM_PATH"] = find_libllvm()
    if chosen.startswith("cuda") and not drjit.has_backend(drjit.JitBackend.CUDA):
        raise BackendError(
            f"{chosen} needs an NVIDIA GPU with its driver, and none was found: without --gpu, and "
            f"without {VARIANT} in the environment, the CPU is used"
        )
    return chosen


def prefer_cuda() -> bool:
    """Whether this process runs on a GPU; sets `HAIRSTAGE_VARIANT` to CUDA if it is unset and there
    is a CUDA device."""
    if not os.environ.get(VARIANT) and drjit.has_backend(drjit.JitBackend.CUDA):
        os.environ[VARIANT] = "cuda_ad_rgb"
    return os.environ.get(VARIANT, "").startswith("cuda")


def array_types(variant: str | None = None) -> Any:
    """Dr.Jit's module of array types for the variant: `drjit.llvm` or `drjit.cuda`."""
    chosen = chosen_variant(variant)
    if chosen.startswith("cuda"):
        return drjit.cuda
    if chosen.startswith("llvm"):
        return drjit.llvm
    raise BackendError(
        f"unsupported variant {chosen!r}: choose llvm_* or cuda_* in HAIRSTAGE_VARIANT"
    )


def for_kernels(values: ArrayLike, dtype: DTypeLike = np.float32) -> NDArray[Any]:
    """A copy of `values`, of the same shape, as input of a Dr.Jit array type.

    Aligned to a packet, with room for another at the end: LLVM kernels read NumPy's memory in
    place, up to 60 bytes past its end, and are compiled anew for other alignments.
    """
    values = np.asarray(values)
    size = values.size * np.dtype(dtype).itemsize
    memory = np.zeros(size + 2 * _PACKET, np.uint8)
    start = -memory.ctypes.data % _PACKET
    copy = memory[start : start + size].view(dtype).reshape(values.shape)
    copy[...] = values
    return copy


def rows_of(value: Any) -> NDArray[Any]:
    """The lanes of a Dr.Jit variable as rows: `(N,)` of a number, `(N, c)` of a vector.

    `np.array` of a vector would compile a kernel for each number of lanes.
    """
    drjit.eval(value)
    if drjit.depth_v(value) < 2:
        return np.array(value)
    return np.stack([np.array(component) for component in value], axis=-1)
