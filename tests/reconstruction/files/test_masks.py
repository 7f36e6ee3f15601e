"""Masks as PNG."""

from __future__ import annotations

import zlib

import bombs
import cv2
import numpy as np
import pytest

from reconstruction.files.masks import decode_mask, read_mask


@pytest.fixture
def png() -> bytes:
    grey = np.array([[0, 127, 128], [255, 3, 200]], np.uint8)
    return bytes(cv2.imencode(".png", grey)[1])


def test_half_grey_and_above_is_the_mask(png, tmp_path):
    (tmp_path / "m.png").write_bytes(png)
    mask = read_mask(tmp_path / "m.png", 3, 2)
    assert mask.tolist() == [[False, False, True], [True, False, True]]


def test_labels_are_no_mask(tmp_path):
    """0 and 1, as programs for marking write them, were taken for a mask that shows nothing."""
    labels = np.array([[0, 1, 1], [0, 0, 1]], np.uint8)
    with pytest.raises(ValueError, match="its brightest pixel is 1, expected 128"):
        decode_mask(bytes(cv2.imencode(".png", labels)[1]), 3, 2)
    assert not decode_mask(bytes(cv2.imencode(".png", 0 * labels)[1]), 3, 2).any()


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_mask_in_alpha_alone_is_not_taken_for_one_of_all_pixels(kind):
    """White under a transparent background, as of a picture that was cut out, was hair all over."""
    white = np.iinfo(kind).max
    image = np.full((2, 3, 4), white, kind)
    image[:, 1:, 3] = 0
    with pytest.raises(ValueError, match="is 33% opaque, but 100% of its pixels are half grey"):
        decode_mask(bytes(cv2.imencode(".png", image)[1]), 3, 2)
    image[:, 1:, :3] = 0  # black there: the same mask twice
    same = decode_mask(bytes(cv2.imencode(".png", image)[1]), 3, 2)
    assert same.tolist() == [[True, False, False]] * 2
    image[..., 3] = white
    opaque = decode_mask(bytes(cv2.imencode(".png", image)[1]), 3, 2)
    assert opaque.tolist() == same.tolist()


def test_a_file_that_unpacks_to_more_than_its_pixels_is_refused():
    data = zlib.compress(bytes(256 << 20), 1)
    parts = [data[:1000], data[1000:]]
    for split in ([data], parts):
        more = b"".join(bombs.chunk(b"IDAT", part) for part in split[:-1])
        with pytest.raises(ValueError, match="more data than these pixels need"):
            decode_mask(bombs.png(640, 480, more=more, data=split[-1]), 640, 480)
    many = bombs.chunk(b"tEXt", b"k\0" + bytes(1 << 20))
    assert not decode_mask(bombs.png(640, 480, more=many), 640, 480).any()


def test_wrong_sizes_in_a_mask_file_are_refused(png, monkeypatch):
    with pytest.raises(ValueError, match="expected a PNG of 2x3 pixels, got 3x2"):
        decode_mask(png, 2, 3)
    with pytest.raises(ValueError, match="another file"):
        decode_mask(b"GIF89a" + bytes(40), 3, 2)
    with pytest.raises(ValueError, match="damaged"):
        decode_mask(png[:-14], 3, 2)
    data_length = png.index(b"IDAT") - 4  # OpenCV makes room for as much as it says
    monkeypatch.setattr(cv2, "imdecode", None)
    gigabyte = png[:data_length] + (1 << 30).to_bytes(4, "big") + png[data_length + 4 :]
    with pytest.raises(ValueError, match="damaged"):
        decode_mask(gigabyte, 3, 2)
