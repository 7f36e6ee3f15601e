"""LPIPS by a network of the user's: here one that we write, the mean of absolute differences."""

from __future__ import annotations

import numpy as np
import pytest

from appearance import scores
from appearance.metrics.lpips import VARIABLE
from appearance.metrics.scores import scores_unavailable


def _field(number: int, value: int | bytes | str) -> bytes:
    """A field of a protocol buffer."""
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    data = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def _varint(n: int) -> bytes:
    return bytes([n & 127 | 128]) + _varint(n >> 7) if n > 127 else bytes([n])


def _value(name: str) -> bytes:
    """A float tensor `(1, 3, h, w)`."""
    dims = [_field(1, 1), _field(1, 3), _field(2, "h"), _field(2, "w")]
    shape = b"".join(_field(1, d) for d in dims)
    return _field(1, name) + _field(2, _field(1, _field(1, 1) + _field(2, shape)))


def _node(kind: str, inputs: list[str], output: str) -> bytes:
    return b"".join(_field(1, x) for x in inputs) + _field(2, output) + _field(4, kind)


@pytest.fixture
def network(tmp_path, monkeypatch):
    nodes = [
        _node("Sub", ["in0", "in1"], "difference"),
        _node("Abs", ["difference"], "size"),
        _node("ReduceMean", ["size"], "out"),
    ]
    graph = b"".join(_field(1, n) for n in nodes) + _field(2, "distance")
    graph += b"".join(_field(11, _value(n)) for n in ("in0", "in1")) + _field(12, _value("out"))
    file = tmp_path / "distance.onnx"
    file.write_bytes(_field(1, 8) + _field(8, _field(2, 13)) + _field(7, graph))
    monkeypatch.setenv(VARIABLE, str(file))
    return file


def pictures(size: int = 80):
    rng = np.random.default_rng(0)
    truth = rng.uniform(size=(size, size, 3))
    mask = np.zeros((size, size), bool)
    mask[:, : size // 2] = True
    return np.clip(truth + 0.1, 0, 1), truth, mask


def test_pictures_are_compared_on_the_mask_in_minus_one_to_one(network):
    image, truth, mask = pictures()
    wanted = 2 * np.abs(image - truth)[mask].sum() / truth.size
    assert scores(image, truth, mask)["lpips"] == pytest.approx(wanted, rel=1e-4)
    assert scores_unavailable() == {}


def test_small_pictures_are_enlarged_to_what_the_network_needs(network):
    image, truth, _ = pictures(20)
    assert scores(image, image)["lpips"] == 0
    assert scores(image, truth)["lpips"] > 0


def test_without_weights_there_is_a_reason_in_place_of_a_score(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    assert set(scores(*pictures())) == {"psnr", "ssim"}
    assert VARIABLE in scores_unavailable()["lpips"]


def test_a_file_that_is_no_network_is_named(network):
    network.write_bytes(b"not a network")
    with pytest.raises(ValueError, match=r"distance\.onnx is not an ONNX network"):
        scores(*pictures())
