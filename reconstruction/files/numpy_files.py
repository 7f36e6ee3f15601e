"""NumPy files, read only if header, file and archive agree on the size of an array."""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any

import numpy as np
import numpy.lib.format as npy
from numpy.typing import NDArray

from reconstruction.containment import plain_file

DEFLATE_AT_BEST = 1032
"""Largest compression ratio of deflate."""
ANY_SIZE = 1 << 62
"""No limit on the bytes of an archive: arrays cannot exceed their file."""
PLAIN = "biufU"
"""Kinds of dtypes without objects."""


def read_array(path: Path) -> NDArray[Any]:
    """The array of an `.npy` file, of any shape. Raises `ValueError`."""
    with plain_file(path).open("rb") as file:
        return _array(file, path.stat().st_size, PLAIN)


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an `.npz` file by name, of any shapes. Raises `ValueError`."""
    with opened(path) as archive:
        return {name: member(archive, name) for name in names(archive)}


@contextmanager
def opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """An `.npz` archive; errors, also in the block, become a `ValueError`."""
    try:
        with zipfile.ZipFile(plain_file(path, ANY_SIZE)) as archive:
            yield archive
    except FileNotFoundError:
        raise
    except (zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, EOFError, OSError) as e:
        raise ValueError(f"not a whole .npz archive ({e})") from e
    except RuntimeError as e:  # encrypted, or an unknown compression
        raise ValueError(f"not a whole .npz archive ({e})") from e


def names(archive: zipfile.ZipFile) -> list[str]:
    """The names of an archive's arrays."""
    return [name.removesuffix(".npy") for name in archive.namelist()]


def member(archive: zipfile.ZipFile, name: str, kinds: str = PLAIN) -> NDArray[Any]:
    """One array of any shape, of one of the `kinds` (`dtype.kind`).

    Raises `ValueError`, and errors that `opened` converts.
    """
    try:
        info = archive.getinfo(name + ".npy")
    except KeyError:
        raise ValueError(f"{name} is missing; the archive holds {names(archive)}") from None
    if info.file_size > DEFLATE_AT_BEST * (info.compress_size + 64):
        raise ValueError(
            f"{name}: {info.compress_size} compressed bytes cannot hold {info.file_size}"
        )
    with archive.open(info) as file:
        try:
            return _array(file, info.file_size, kinds)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error


def _array(file: IO[bytes], size: int, kinds: str) -> NDArray[Any]:
    """The array at the start of `file`, of `size` bytes."""
    shape, fortran, dtype = _header(file)
    if dtype.kind not in kinds or dtype.hasobject:
        raise ValueError(f"unexpected type {dtype}")
    if any(n < 0 for n in shape):
        raise ValueError(f"invalid shape {shape}")
    expected = math.prod(shape) * dtype.itemsize
    if expected > size:
        raise ValueError(f"shape {shape} of {dtype} needs {expected} bytes, the file has {size}")
    data = file.read(expected)
    if len(data) != expected:
        raise ValueError(f"truncated, {len(data)} of {expected} bytes")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C").copy()


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    try:
        version = npy.read_magic(file)
        if version == (1, 0):
            return npy.read_array_header_1_0(file)
        if version == (2, 0):
            return npy.read_array_header_2_0(file)
    except (SyntaxError, TokenError, MemoryError, RecursionError) as error:
        raise ValueError(f"invalid header ({error})") from error
    raise ValueError(f"unknown .npy version {version}")
