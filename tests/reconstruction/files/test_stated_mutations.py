"""Headers with wrong bytes: the light of an independent reader, or an error, never other light."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import stated_files as files
import tifffile
from stated_files import LIGHT, H, W

from reconstruction.files.exr import read_exr
from reconstruction.files.pictures import PictureError, Sensor, picture_size, read_picture
from reconstruction.files.radiance import read_hdr

LARGE = 1_000_000
ROOM, PLACE = (W + 3, H + 4), (2, 1)
"""Display window, and the data window's place in it."""


def of_exr(path: Path) -> int:
    """An EXR; the bytes of its header."""
    window = {"displayWindow": ((0, 0), (ROOM[0] - 1, ROOM[1] - 1))}
    window["dataWindow"] = (PLACE, (PLACE[0] + W - 1, PLACE[1] + H - 1))
    rec709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
    files.exr(path, LIGHT, chromaticities=rec709, **window)
    return path.stat().st_size - H * (8 + 12 * W) - 8 * H


def exr_by_oiio(path: Path) -> Any:
    source = oiio.ImageInput.open(str(path))
    if source is None:
        return None
    spec, pixels = source.spec(), source.read_image(0, 0, 0, 3, oiio.FLOAT)
    if pixels is None or list(spec.channelnames[:3]) != ["R", "G", "B"]:
        return None
    xy = spec.getattribute("chromaticities")
    if xy is not None:
        pixels = pixels @ _to_rec709(np.reshape(xy, (4, 2))).T
    out = np.zeros((spec.full_height, spec.full_width, 3), np.float32)
    for y in range(spec.height):
        for x in range(spec.width):
            row, column = y + spec.y - spec.full_y, x + spec.x - spec.full_x
            if 0 <= row < spec.full_height and 0 <= column < spec.full_width:
                out[row, column] = pixels[y, x]
    return out


def _to_rec709(xy: Any) -> Any:
    """By the colours' tristimulus values: white adapted in Bradford's space."""
    own = [[0.64, 0.33], [0.30, 0.60], [0.15, 0.06], [0.3127, 0.3290]]
    bradford = [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]

    def columns(points: Any) -> Any:
        xyz = np.array([[x / y, 1, (1 - x - y) / y] for x, y in points]).T
        return xyz[:, :3] * (np.linalg.inv(xyz[:, :3]) @ xyz[:, 3])

    one, two = columns(xy), columns(own)
    gain = np.diag((bradford @ two.sum(1)) / (bradford @ one.sum(1)))
    return np.linalg.inv(two) @ np.linalg.inv(bradford) @ gain @ bradford @ one


def of_hdr(path: Path) -> int:
    files.hdr(path, LIGHT * 4, "EXPOSURE=4.00\nVIEW= -vtv\n")
    return path.read_bytes().index(b"+X") + 6


def hdr_by_oiio(path: Path) -> Any:
    source = oiio.ImageInput.open(str(path))
    pixels = None if source is None else source.read_image(oiio.FLOAT)
    if pixels is None:
        return None
    upright = oiio.ImageBuf(np.ascontiguousarray(pixels))
    upright.specmod().attribute("Orientation", source.spec().get_int_attribute("Orientation", 1))
    upright = oiio.ImageBufAlgo.reorient(upright).get_pixels(oiio.FLOAT)
    return upright / source.spec().get_float_attribute("hdr:exposure", 1.0)


def of_tiff(path: Path) -> int:
    counts = np.rint(LIGHT * 65535).astype(np.uint16)
    files.tiff(path, counts, extratags=[(281, 3, 3, (65535,) * 3, True)])
    return path.stat().st_size


def tiff_by_tifffile(path: Path) -> Any:
    with tifffile.TiffFile(path) as file:
        page = file.pages[0]
        values = page.asarray()
        most = {int(v) for v in np.atleast_1d(page.tags[281].value)} if 281 in page.tags else {0}
        if page.photometric == 0:
            values = np.iinfo(values.dtype).max - values
        if values.ndim == 3 and page.planarconfig == 2:
            values = values.transpose(1, 2, 0)
    white = np.iinfo(values.dtype).max if values.dtype.kind in "iu" else 1
    if max(most) < white and max(most) + 1 in 2 ** np.arange(1, 32):
        white = max(most)
    values = values if values.ndim == 3 else values[..., None]
    values = values[..., :3] if values.shape[-1] > 2 else values[..., :1].repeat(3, -1)
    share = values / white
    if values.dtype != np.uint8:
        return share
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


BLACKS = (200, 256, 264, 330)


def of_dng(path: Path) -> int:
    black = np.tile(np.reshape(BLACKS, (2, 2)), (H // 2, W // 2))
    counts = black + files.mosaic(np.full((H, W, 3), (0.3, 0.2, 0.1))) * (4095 - black)
    files.dng(path, counts, black=BLACKS, repeat=(2, 2))
    return path.stat().st_size - 2 * H * W


def dng_by_tifffile(path: Path) -> Any:
    with tifffile.TiffFile(path) as file:
        tags = {
            t.code: np.divide(t.value[::2], t.value[1::2]) if t.dtype in (5, 10) else t.value
            for t in file.pages[0].tags
        }
        counts = file.pages[0].asarray().astype(float)
    rows, columns = np.atleast_1d(tags.get(50713, (1, 1)))
    black = np.resize(np.atleast_1d(tags.get(50714, 0)), (rows, columns))
    h, w = counts.shape
    black = np.tile(black, (h // rows + 1, w // columns + 1))[:h, :w]
    share = (counts - black) / (np.atleast_1d(tags.get(50717, 65535))[0] - black)
    plane = np.reshape(list(bytes(tags[33422])), (2, 2))
    return np.array([share[np.tile(plane == k, (h // 2, w // 2))].mean() for k in range(3)])


def dng_colour(path: Path) -> Any:
    light = read_picture(path, Sensor(orientation="stored"), picture_size(path)).light
    return light[4:-4, 4:-4].mean(axis=(0, 1))


def picture(path: Path) -> Any:
    return read_picture(path, Sensor(orientation="stored"), picture_size(path)).light


FORMATS: dict[str, tuple[Callable[[Path], int], Callable[[Path], Any], Callable[[Path], Any]]] = {
    "exr": (of_exr, lambda path: read_exr(path)[0], exr_by_oiio),
    "hdr": (of_hdr, read_hdr, hdr_by_oiio),
    "tif": (of_tiff, picture, tiff_by_tifffile),
    "dng": (of_dng, dng_colour, dng_by_tifffile),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("count", [40, pytest.param(1000, marks=pytest.mark.slow)])
def test_a_wrong_header_never_changes_the_light_silently(suffix, count, tmp_path):
    write, ours, reference = FORMATS[suffix]
    path, rng, silent = tmp_path / f"a.{suffix}", np.random.default_rng(0), []
    length = write(path)
    whole = path.read_bytes()
    first = ours(path)
    np.testing.assert_allclose(first, reference(path), atol=2e-3)
    start, end = 0, length
    if suffix in ("tif", "dng"):
        start = struct.unpack_from("<I", whole, 4)[0]
        end = min(length, start + 1000)
    for _ in range(count):
        data = bytearray(whole)
        for at in rng.integers(start, end, rng.integers(1, 3)):
            data[at] = rng.choice([rng.integers(256), data[at] ^ (1 << rng.integers(8))])
        path.write_bytes(data)
        try:
            found = ours(path)
        except (PictureError, ValueError):
            continue
        try:
            expected = reference(path)
        except Exception:  # it cannot read the file: only the original light is right
            expected = None
        if expected is None or expected.shape != found.shape:
            expected = first
        same = found.shape == expected.shape
        if same and found.size > LARGE:  # of a display window: some lines and columns of it
            step = -(-found.size // LARGE)
            rows = np.unique([*range(0, len(found), step), *np.flatnonzero(expected.any((1, 2)))])
            found, expected = found[rows], expected[rows]
        if not (same and np.allclose(found, expected, rtol=0.01, atol=2e-3, equal_nan=True)):
            changed = [(i, whole[i], data[i]) for i in range(len(data)) if data[i] != whole[i]]
            silent.append((changed, found.shape))
    assert not silent, silent
