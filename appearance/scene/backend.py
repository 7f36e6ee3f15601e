"""Chooses Mitsuba's back end, or says what to install."""

from __future__ import annotations

import sys

import drjit as dr
import mitsuba as mi

from reconstruction.array_backend import chosen_variant
from reconstruction.libllvm import BackendError, find_libllvm

__all__ = ["BackendError", "ensure_backend", "find_libllvm"]


def ensure_backend(variant: str | None = None, *, threads: int | None = None) -> str:
    """Set Mitsuba's variant once and return it; `threads` is how many Dr.Jit runs on, from now.

    `variant` or `HAIRSTAGE_VARIANT` overrides the choice; otherwise LLVM, which runs on every CPU.
    Raises `BackendError` when libLLVM is too old or absent, or the variant is none that runs here.
    """
    chosen = chosen_variant(variant)
    if chosen not in mi.variants():
        raise BackendError(f"there is no variant {chosen!r}: choose llvm_ad_rgb or cuda_ad_rgb")
    if mi.variant() != chosen:
        mi.set_variant(chosen)
    if threads is not None:
        dr.set_thread_count(threads)
    return chosen


if __name__ == "__main__":
    try:
        print(f"libLLVM: {find_libllvm()}")
    except BackendError as error:
        sys.exit(str(error))
