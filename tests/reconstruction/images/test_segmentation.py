"""The user's network as a source of masks: small ONNX files written here, byte by byte."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from reconstruction import Capture
from reconstruction.images.segmentation import Network, NetworkError
from reconstruction.images.silhouettes import silhouette
from reconstruction.masks import hair_masks
from reconstruction.reconstruct_options import NetworkOptions


def network_of(file: str, **options: Any) -> Network:
    return Network(NetworkOptions(file, **options))


def varint(number: int) -> bytes:
    low, rest = number & 127, number >> 7
    return bytes([low | 128]) + varint(rest) if rest else bytes([low])


def field(number: int, value: int | str | bytes) -> bytes:
    """A field of a protocol buffer: a number, a text or a message."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    content = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(content)) + content


def tensor(name: str, values: NDArray[np.float32]) -> bytes:
    shape = b"".join(field(1, d) for d in values.shape)
    return shape + field(2, 1) + field(8, name) + field(9, values.astype(np.float32).tobytes())


def value_info(name: str, shape: tuple[int, ...]) -> bytes:
    dimensions = b"".join(field(1, field(1, d)) for d in shape)
    return field(1, name) + field(2, field(1, field(1, 1) + field(2, dimensions)))


def one_layer(path: Path, weights: list[list[float]], bias: list[float]) -> str:
    """An ONNX network (IR 8, opset 13): one 1×1 convolution of RGB; returns its file name."""
    w = np.array(weights, np.float32)[..., None, None]
    node = b"".join(field(1, n) for n in ("image", "w", "b"))
    node += field(2, "scores") + field(4, "Conv")
    graph = field(1, node) + field(2, "net") + field(5, tensor("w", w))
    graph += field(5, tensor("b", np.array(bias, np.float32)))
    graph += field(11, value_info("image", (1, 3, 64, 64)))
    graph += field(12, value_info("scores", (1, len(bias), 64, 64)))
    path.write_bytes(field(1, 8) + field(7, graph) + field(8, field(1, "") + field(2, 13)))
    return str(path)


def left_half_bright() -> NDArray[np.float64]:
    image = np.full((64, 64, 3), 0.05)
    image[:, :32] = (0.8, 0.7, 0.6)
    return image


def test_the_class_of_hair_wins_pixel_by_pixel(tmp_path: Path) -> None:
    bright = one_layer(tmp_path / "two.onnx", [[-1, -1, -1], [1, 1, 1]], [1.5, -1.5])
    hair = network_of(bright).hair_pixels(left_half_bright())
    assert hair[:, :32].all()
    assert not hair[:, 32:].any()
    assert np.array_equal(network_of(bright, hair=0).hair_pixels(left_half_bright()), ~hair)


def test_one_score_is_a_logit_or_a_probability(tmp_path: Path) -> None:
    logit = network_of(one_layer(tmp_path / "logit.onnx", [[1, 1, 1]], [-1.5]))
    share = network_of(one_layer(tmp_path / "share.onnx", [[1 / 3, 1 / 3, 1 / 3]], [0.0]))
    for network in (logit, share):
        assert network.hair_pixels(left_half_bright())[:, :32].all()
        assert not network.hair_pixels(left_half_bright())[:, 32:].any()


def test_pictures_are_scaled_to_the_networks_size_and_masks_back(tmp_path: Path) -> None:
    bright = one_layer(tmp_path / "two.onnx", [[-1, -1, -1], [1, 1, 1]], [1.5, -1.5])
    hair = network_of(bright, size=(32, 16)).hair_pixels(left_half_bright())
    assert hair.shape == (64, 64)
    assert hair[:, :30].all()
    assert not hair[:, 34:].any()


def test_mean_and_deviation_shift_what_the_network_sees(tmp_path: Path) -> None:
    file = one_layer(tmp_path / "plain.onnx", [[1, 1, 1]], [0.0])
    shifted = network_of(file, mean=(0.5, 0.5, 0.5), std=(0.2, 0.2, 0.2))
    assert shifted.hair_pixels(left_half_bright())[:, :32].all()
    assert not shifted.hair_pixels(left_half_bright())[:, 32:].any()


def test_a_dark_picture_is_no_number_out_of_range(tmp_path: Path) -> None:
    network = network_of(one_layer(tmp_path / "logit.onnx", [[1, 1, 1]], [-1.5]))
    assert not network.hair_pixels(np.zeros((64, 64, 3))).any()


def test_files_that_are_no_networks_are_named(tmp_path: Path) -> None:
    with pytest.raises(NetworkError, match=r"absent\.onnx: no such file"):
        network_of(str(tmp_path / "absent.onnx")).hair_pixels(left_half_bright())
    (tmp_path / "broken.onnx").write_bytes(b"xx")
    with pytest.raises(NetworkError, match=r"broken\.onnx: not an ONNX network"):
        network_of(str(tmp_path / "broken.onnx")).hair_pixels(left_half_bright())
    two = one_layer(tmp_path / "two.onnx", [[0, 0, 0], [0, 0, 0]], [0, 1])
    with pytest.raises(NetworkError, match="hair is class 7, but it tells 2 classes"):
        network_of(two, hair=7).hair_pixels(left_half_bright())


def test_masks_ask_the_network_of_what_is_lit_and_say_so(
    tmp_path: Path, sphere_capture: Capture, shoot: Callable[..., Capture]
) -> None:
    network = network_of(one_layer(tmp_path / "all.onnx", [[0, 0, 0]], [1.0]))
    masks = hair_masks(sphere_capture, network=network)
    for name, mask in masks.items():
        assert mask.source == "network"
        assert np.array_equal(mask.hair, silhouette(sphere_capture, name))
        assert not mask.skin.any()
