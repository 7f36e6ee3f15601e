"""Chooses Mitsuba's back end, or says what to install."""

from __future__ import annotations

import sys

from reconstruction.array_backend import BackendError, chosen_variant, find_libllvm

__all__ = ["BackendError", "ensure_backend", "find_libllvm"]


def ensure_backend(variant: str | None = None) -> str:
    """Set Mitsuba's variant once and return it.

    `variant` or `HAIRSTAGE_VARIANT` overrides the choice; otherwise LLVM, which runs on every CPU.
    Raises `BackendError` when libLLVM is too old or absent.
    """
    chosen = chosen_variant(variant)
    import mitsuba as mi

    if mi.variant() != chosen:
        mi.set_variant(chosen)
    return chosen


if __name__ == "__main__":
    try:
        print(f"libLLVM: {find_libllvm()}")
    except BackendError as error:
        sys.exit(str(error))
