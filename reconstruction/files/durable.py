"""Files that are whole on the disk, or not there: written, flushed, renamed."""

from __future__ import annotations

import ctypes
import errno
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path
from typing import Any

PART = ".part-"  # what the names of files begin with that are not whole yet
PAGE = 4096  # bytes; what goes past the page cache starts and ends on a multiple of it
RESERVE = 256 << 20
"""Bytes that stay free: for what is under way on other threads, the manifest, the jobs' records."""


class DiskFull(OSError):
    """The disk has no room for a file, or would have no reserve left; names path and bytes."""

    def __init__(self, path: Path, needed: int, reserve: int = 0) -> None:
        self.needed, self.free = needed, _free(path)
        kept = f" and a reserve of {reserve:,}" if reserve else ""
        super().__init__(
            errno.ENOSPC,
            f"No space left on device: {needed:,} bytes are needed{kept}, {self.free:,} are free; "
            "make room, then resume",
            str(path),
        )


def require_free(path: Path, needed: int, reserve: int = RESERVE) -> None:
    """Raise `DiskFull` where a file of `needed` bytes would leave less than `reserve` free."""
    if _free(path) < needed + reserve:
        raise DiskFull(path, needed, reserve)


@contextmanager
def naming_full_disk(path: Path, needed: int) -> Iterator[None]:
    """Turn the bare error of a disk (or a quota) that is full into `DiskFull`."""
    try:
        yield
    except OSError as error:
        if isinstance(error, DiskFull) or error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise DiskFull(path, needed) from error


def write_pages(path: Path, data: memoryview) -> bool:
    """Write whole pages (memory and length aligned to `PAGE`); `flush` makes them durable.

    They go past the page cache where the file system lets them, which is returned: copying into it
    and writing back cost more processor time than all else but the checksum. A failed file is
    removed.
    """
    direct = getattr(os, "O_DIRECT", 0)
    try:
        with naming_full_disk(path, len(data)):
            try:
                _write(path, data, direct)
            except OSError as error:  # a file system without direct input and output
                if error.errno != errno.EINVAL:
                    raise
                _write(path, data, 0)
                direct = 0
    except OSError:
        path.unlink(missing_ok=True)
        raise
    return direct != 0


def _write(path: Path, data: memoryview, flags: int) -> None:
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | flags, 0o666)
    try:
        _write_all(handle, data)
    finally:
        os.close(handle)


@contextmanager
def writing(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """A temporary path to write to; afterwards `path` is whole, and where `durable` on the disk.

    Where the block raises, nothing is left of what it wrote; an `OSError` names a file.
    """
    temporary = part(path)
    try:
        yield temporary
        if durable:
            flush(temporary)
        temporary.replace(path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno and error.filename is None:
            error.filename = str(path)  # of a full disk `write` does not say where
        raise


def write_whole(path: Path, data: bytes, *, durable: bool = True) -> None:
    """Write a small file: temporary name, flush, rename. A failed one leaves nothing."""
    with naming_full_disk(path, len(data)), writing(path, durable=durable) as temporary:
        temporary.write_bytes(data)


def write_json(path: Path, data: Any, *, durable: bool = True) -> None:
    """Write JSON; numbers that are not finite are an error, never NaN."""
    text = json.dumps(data, indent=1, allow_nan=False) + "\n"
    write_whole(path, text.encode(), durable=durable)


def append_whole(file: FileIO, data: bytes) -> None:
    """Append to an unbuffered file and flush it; what fails is cut off again."""
    before = os.fstat(file.fileno()).st_size
    try:
        with naming_full_disk(Path(os.fspath(file.name)), len(data)):
            _write_all(file.fileno(), memoryview(data))
            os.fsync(file.fileno())
    except OSError:
        with suppress(OSError):
            file.truncate(before)
        raise


def part(path: Path) -> Path:
    """The temporary name of a file that is not whole yet; by its suffix writers know the format."""
    return path.with_name(PART + path.name)


def replace_durably(temporary: Path, path: Path) -> None:
    """Flush `temporary` to disk and rename it to `path`: afterwards it is whole or not there."""
    flush(temporary)
    temporary.replace(path)


class FileSystem:
    """The file system that `folder` is on, whose `flush` makes all files and names on it durable:
    for many small files a fraction of what a flush of each takes.

    Errors of writing back what went through the page cache, from the construction on, are raised by
    Linux from 5.8 on only: use it for what `write_pages` wrote past it. Raises `OSError`;
    `supported` is False where the system has no such call.
    """

    def __init__(self, folder: Path) -> None:
        library = ctypes.CDLL(None, use_errno=True)
        self.supported = hasattr(library, "syncfs")
        self._library = library
        self._handle = os.open(folder, os.O_RDONLY)

    def flush(self) -> None:
        """Wait until everything that was written to it is on the disk."""
        if self._library.syncfs(self._handle) != 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))

    def close(self) -> None:
        """Let go of it; more than once does nothing."""
        handle, self._handle = self._handle, -1
        if handle >= 0:
            os.close(handle)

    __del__ = close


def flush(path: Path) -> None:
    """Make a file's contents durable, or the names in a folder."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _write_all(handle: int, data: memoryview) -> None:
    done = 0
    while done < len(data):
        done += os.write(handle, data[done:])


def _free(path: Path) -> int:
    """Bytes that this user may still write where `path` is, or will be."""
    while True:
        try:
            disk = os.statvfs(path)
            break
        except FileNotFoundError:
            path = path.parent
    return disk.f_bavail * disk.f_frsize
