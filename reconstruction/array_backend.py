"""One place that chooses Dr.Jit's back end and hands it NumPy's arrays."""

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
    """The variant to run: `variant`, else `HAIRSTAGE_VARIANT`, else LLVM, which every CPU runs.

    Named as Mitsuba's are, such as `llvm_ad_rgb` or `cuda_ad_rgb`. Makes libLLVM known to Dr.Jit
    where it is needed; raises `BackendError` when it is too old or absent, or without a GPU.
    """
    chosen = variant or os.environ.get(VARIANT) or "llvm_ad_rgb"
    if chosen.startswith("llvm"):
        os.environ["DRJIT_LIBLLVM_PATH"] = find_libllvm()
    if chosen.startswith("cuda") and not drjit.has_backend(drjit.JitBackend.CUDA):
        raise BackendError(
            f"{chosen} needs an NVIDIA GPU with its driver, and none is found: leave {VARIANT} "
            "unset to run on the CPU"
        )
    return chosen


def prefer_cuda() -> bool:
    """Whether this process runs on a GPU: it does where there is one and nothing else was chosen.

    `HAIRSTAGE_VARIANT` comes first; where it says nothing and there is a CUDA device, it says CUDA
    from now on.
    """
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


def rows_of(value: Any) -> NDArray[Any]:
    """The lanes of a Dr.Jit variable as rows: `(N,)` of a number, `(N, c)` of a vector.

    NumPy's own way to a vector, by `np.array`, compiles a kernel for each number of lanes.
    """
    drjit.eval(value)
    if drjit.depth_v(value) < 2:
        return np.array(value)
    return np.stack([np.array(component) for component in value], axis=-1)
