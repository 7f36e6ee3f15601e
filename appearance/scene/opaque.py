"""Numbers that kernels read from memory, where literals would be compiled into them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Array


def opaque(values: ArrayLike) -> list[Any]:
    """One Dr.Jit float per number of `values`, of any shape, which kernels read from memory.

    A literal would become part of the kernel, and every camera, pose or light bank would be
    compiled anew: seconds instead of milliseconds.
    """
    return [dr.opaque(mi.Float, float(v)) for v in np.asarray(values, float).ravel()]


def opaque_index(value: int) -> Any:
    """`value` as a Dr.Jit integer that kernels read from memory."""
    return dr.opaque(mi.UInt32, value)


def opaque_matrix(matrix: Array) -> Any:
    """`matrix (3, 3)` that kernels read from memory."""
    return mi.Matrix3f(*opaque(matrix))
