"""NumPy's `.npy` files that somebody else may have written."""

from __future__ import annotations

from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.containment import plain_file


def read_npy(path: str | Path) -> NDArray[Any]:
    """The array of a file of which the header claims no more than the file holds.

    Raises `OSError`, and `ValueError` for what is no array, or not all of one.
    """
    try:
        # mapped, its size is held against the file's before there is memory for it
        return np.array(np.load(plain_file(path), mmap_mode="r", allow_pickle=False))
    except (EOFError, SyntaxError, TokenError) as error:  # of a header that is cut off
        raise ValueError(f"no NumPy array ({error})") from error
    except ValueError as error:
        if "mmap length" not in str(error):
            raise
        raise ValueError("cut off: its header claims more numbers than it has") from error
