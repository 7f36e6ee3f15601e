"""Pictures of a few bytes whose headers claim 60,000 x 60,000 pixels, over ten gigabytes."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from dng_writer import write_dng

from reconstruction import write_exr
from reconstruction.files.pictures import PictureError, Sensor, read_picture
from reconstruction.report.report import peak_memory

SIDE = 60_000
WIDTH, HEIGHT, ROWS_A_STRIP, LONG = 256, 257, 278, 4


def of_png(path: Path) -> None:
    header = b"IHDR" + struct.pack(">IIBBBBB", SIDE, SIDE, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk)


def of_tiff(path: Path) -> None:
    if path.suffix == ".dng":
        write_dng(path, np.zeros((24, 32), np.uint16))
    else:
        assert cv2.imwrite(str(path), np.zeros((24, 24, 3), np.uint16))
    data = bytearray(path.read_bytes())
    (first,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, first)
    for at in range(first + 2, first + 2 + 12 * count, 12):
        (tag,) = struct.unpack_from("<H", data, at)
        if tag in (WIDTH, HEIGHT, ROWS_A_STRIP):
            struct.pack_into("<HHII", data, at, tag, LONG, 1, SIDE)
    path.write_bytes(data)


def of_exr(path: Path) -> None:
    write_exr(path, np.zeros((24, 24, 3), np.float32))
    data = bytearray(path.read_bytes())
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        struct.pack_into("<4i", data, data.index(name) + len(name) + 4, 0, 0, SIDE - 1, SIDE - 1)
    path.write_bytes(data)


def of_jpeg(path: Path) -> None:
    assert cv2.imwrite(str(path), np.zeros((24, 24, 3), np.uint8))
    data = bytearray(path.read_bytes())
    struct.pack_into(">HH", data, data.index(b"\xff\xc0") + 5, SIDE, SIDE)
    path.write_bytes(data)


def of_avif(path: Path) -> None:
    assert cv2.imwrite(str(path), np.zeros((24, 24, 3), np.uint8))
    data = bytearray(path.read_bytes())
    struct.pack_into(">II", data, data.index(b"ispe") + 8, SIDE, SIDE)
    path.write_bytes(data)


CLAIMS: dict[str, Callable[[Path], None]] = {
    **{".png": of_png, ".tif": of_tiff, ".dng": of_tiff},
    **{".exr": of_exr, ".jpg": of_jpeg, ".avif": of_avif},
}


@pytest.mark.parametrize("side", [24, SIDE], ids=["camera of 24", "camera that large"])
@pytest.mark.parametrize("suffix", CLAIMS)
def test_a_claim_of_ten_gigabytes_takes_no_memory(suffix: str, side: int, tmp_path: Path) -> None:
    path = tmp_path / f"claims{suffix}"
    CLAIMS[suffix](path)
    with peak_memory() as before:
        pass
    with peak_memory() as peak, pytest.raises(PictureError, match=f"claims{suffix}") as problem:
        read_picture(path, Sensor(), (side, side))
    assert "copy it again" in str(problem.value) or "60000x60000 pixels" in str(problem.value)
    if before.gb is not None and peak.gb is not None:
        assert peak.gb - before.gb < 0.2
