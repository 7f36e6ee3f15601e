"""LPIPS (Zhang et al. 2018), where the user supplies its weights.

They are not part of this project. The environment variable `HAIRSTAGE_LPIPS` names an ONNX file of
a network that takes two images `in0` and `in1` `(1, 3, H, W)` in [-1, 1], which the authors'
package writes in three lines:

    import lpips, torch
    x = torch.zeros(1, 3, 64, 64)
    torch.onnx.export(lpips.LPIPS(net="alex"), (x, x), "lpips.onnx", input_names=["in0", "in1"],
                      dynamic_axes={n: {2: "h", 3: "w"} for n in ("in0", "in1")})
"""

from __future__ import annotations

import os
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from reconstruction.arrays import AnyFloats, Bools, Floats

VARIABLE = "HAIRSTAGE_LPIPS"
UNAVAILABLE = f"LPIPS needs network weights: {VARIABLE} names no ONNX file"
_LEAST = 64
"""Pixels on a side: smaller images are enlarged for AlexNet."""


def lpips(image: AnyFloats, truth: AnyFloats, mask: Bools) -> float | None:
    """Distance of two images `(H, W, 3)` with values in [0, 1], both black outside `mask (H, W)`.

    None where no weights are given; `ValueError` where the file is not such a network.
    """
    file = os.environ.get(VARIABLE)
    if not file:
        return None
    try:
        network = _network(file)
        for name, picture in (("in0", image), ("in1", truth)):
            network.setInput(_blob(np.where(mask[..., None], picture, 0.0)), name)
        return float(np.mean(network.forward()))
    except cv2.error as error:
        raise ValueError(
            f"{VARIABLE}={file} is not an ONNX network of two images in0 and in1: {error.err}"
        ) from error


@lru_cache(maxsize=1)
def _network(file: str) -> Any:
    return cv2.dnn.readNetFromONNX(file)


def _blob(picture: AnyFloats) -> Floats:
    least = min(picture.shape[:2])
    if least < _LEAST:
        size = [-(-n * _LEAST // least) for n in picture.shape[1::-1]]
        picture = cv2.resize(picture.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray((2 * picture - 1).transpose(2, 0, 1)[None], np.float32)
