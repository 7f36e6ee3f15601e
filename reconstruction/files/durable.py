"""Durable, atomic writes: temporary name, flush, rename."""

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

PART = ".part-"  # prefix of incomplete files
PAGE = 4096  # bytes; alignment of direct writes
RESERVE = 256 << 20
"""Bytes that stay free for other threads' frames, the manifest and the jobs' records."""


class DiskFull(OSError):
    """The disk has no room for a file and the reserve; names path and bytes."""

    def __init__(self, path: Path, needed: int, reserve: int = 0) -> None:
        self.needed, self.free = needed, _free(path)
        extra = f" and a reserve of {reserve:,}" if reserve else ""
        super().__init__(
            errno.ENOSPC,
            f"No space left on device: {needed:,} bytes are needed{extra}, {self.free:,} are free; "
            "make room, then resume",
            str(path),
        )


def require_free(path: Path, needed: int, reserve: int = RESERVE) -> None:
    """Raise `DiskFull` if a file of `needed` bytes would leave less than `reserve` free."""
    if _free(path) < needed + reserve:
        raise DiskFull(path, needed, reserve)


@contextmanager
def naming_full_disk(path: Path, needed: int) -> Iterator[None]:
    """Raise `DiskFull` instead of a bare `OSError` for a full disk or quota."""
    try:
        yield
    except OSError as error:
        if isinstance(error, DiskFull) or error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise DiskFull(path, needed) from error


def write_pages(path: Path, data: memoryview) -> bool:
    """Write whole pages (memory and length aligned to `PAGE`); `flush` makes them durable.

    Bypasses the page cache, whose copies cost much processor time; returns whether the file system
    supported that. A failed file is removed.
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
    """A temporary path that is renamed to `path` after the block, flushed first if `durable`.

    If the block raises, the temporary file is removed; an `OSError` names a file.
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
            error.filename = str(path)  # `write` on a full disk names no file
        raise


def write_whole(path: Path, data: bytes, *, durable: bool = True) -> None:
    """Write a small file atomically."""
    with naming_full_disk(path, len(data)), writing(path, durable=durable) as temporary:
        temporary.write_bytes(data)


def write_json(path: Path, data: Any, *, durable: bool = True) -> None:
    """Write JSON; numbers that are not finite are an error, never NaN."""
    text = json.dumps(data, indent=1, allow_nan=False) + "\n"
    write_whole(path, text.encode(), durable=durable)


def append_whole(file: FileIO, data: bytes) -> None:
    """Append to an unbuffered file and flush it; a partial append is cut off."""
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
    """The temporary name of an incomplete file, with the same suffix."""
    return path.with_name(PART + path.name)


def replace_durably(temporary: Path, path: Path) -> None:
    """Flush `temporary` to disk and rename it to `path`."""
    flush(temporary)
    temporary.replace(path)


class FileSystem:
    """The file system of `folder`; `flush` makes all its files durable at once (syncfs).

    Only for files that `write_pages` wrote past the page cache: before Linux 5.8, syncfs does not
    report write-back errors. Raises `OSError`; `supported` is False without syncfs.
    """

    def __init__(self, folder: Path) -> None:
        library = ctypes.CDLL(None, use_errno=True)
        self.supported = hasattr(library, "syncfs")
        self._library = library
        self._handle = os.open(folder, os.O_RDONLY)

    def flush(self) -> None:
        """Wait until all writes are on the disk."""
        if self._library.syncfs(self._handle) != 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))

    def close(self) -> None:
        """Close the handle; may be called repeatedly."""
        handle, self._handle = self._handle, -1
        if handle >= 0:
            os.close(handle)

    __del__ = close


def flush(path: Path) -> None:
    """Make a file's contents, or a folder's names, durable."""
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
    """Bytes available to this user at `path`, which need not exist."""
    while True:
        try:
            disk = os.statvfs(path)
            break
        except FileNotFoundError:
            path = path.parent
    return disk.f_bavail * disk.f_frsize
