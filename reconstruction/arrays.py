"""Array types; docstrings give the shapes, as `(N, 3)`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
AnyFloats = NDArray[np.floating]
