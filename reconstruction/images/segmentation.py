"""Hair masks from the user's own segmentation network, an ONNX file run by OpenCV."""

from __future__ import annotations

import hashlib
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from reconstruction.arrays import AnyFloats, Array, Bools
from reconstruction.reconstruct_options import NetworkOptions


class NetworkError(ValueError):
    """A network that cannot be used; the message names its file, what it gave, what is wanted."""


class Network:
    """A network as `NetworkOptions` has it; raises `NetworkError` where the file is none."""

    def __init__(self, options: NetworkOptions) -> None:
        self.options = options

    def hair_pixels(self, image: AnyFloats) -> Bools:
        """The hair's pixels `(H, W)` of a scene-linear picture `(H, W, 3)`; raises as above."""
        o = self.options
        height, width = image.shape[:2]
        picture = cv2.resize(_srgb(image), o.size or (width, height), interpolation=cv2.INTER_AREA)
        planes = ((picture - o.mean) / o.std).transpose(2, 0, 1)[None].astype(np.float32)
        self._net.setInput(np.ascontiguousarray(planes))
        try:
            scores = np.asarray(self._net.forward())
        except cv2.error as error:
            raise NetworkError(
                f"{o.file}: does not take a picture {planes.shape}: {error.err}; give the size "
                "(width, height) that it was made for"
            ) from error
        if scores.ndim != 4 or scores.shape[0] != 1 or not np.isfinite(scores).all():
            got = f"expected finite scores (1, classes, h, w), got {scores.shape}"
            raise NetworkError(f"{o.file}: {got}")
        classes = scores.shape[1]
        if classes > 1 and not 0 <= o.hair < classes:
            raise NetworkError(f"{o.file}: hair is class {o.hair}, but it tells {classes} classes")
        # scores are enlarged, not masks: the edge stays smooth
        planes = [cv2.resize(s, (width, height)) for s in scores[0]]
        if len(planes) > 1:
            return np.asarray(np.argmax(planes, axis=0) == o.hair)
        probability = scores.min() >= 0 and scores.max() <= 1
        return np.asarray(planes[0] > (0.5 if probability else 0.0))

    def to_dict(self) -> dict[str, Any]:
        """What a report says of it: the file, and its SHA-256."""
        data = Path(self.options.file).read_bytes()
        return {"file": self.options.file, "sha256": hashlib.sha256(data).hexdigest()}

    @cached_property
    def _net(self) -> Any:
        if not Path(self.options.file).is_file():
            raise NetworkError(f"{self.options.file}: no such file; expected an ONNX network")
        try:
            return cv2.dnn.readNetFromONNX(self.options.file)
        except cv2.error as error:
            raise NetworkError(f"{self.options.file}: not an ONNX network ({error.err})") from error


def _srgb(image: AnyFloats) -> Array:
    """Exposed to a white of the 99th percentile, display-coded (IEC 61966-2-1)."""
    white = float(np.percentile(image, 99))
    linear = np.clip(image / white, 0, 1) if white > 0 else np.zeros(image.shape)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
