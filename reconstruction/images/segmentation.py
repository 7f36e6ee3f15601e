"""Hair masks from the user's own segmentation network, an ONNX file run by OpenCV."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from reconstruction.arrays import AnyFloats, Array, Bools


class NetworkError(ValueError):
    """A network that cannot be used; the message names its file, what it gave, what is wanted."""


@dataclass(frozen=True)
class Network:
    """A network from a picture `(1, 3, h, w)` to scores `(1, C, h', w')` of C classes.

    It gets RGB in sRGB, exposed so that the 99th percentile is white, as (value - `mean`) / `std`
    with values in [0, 1], scaled to `size` (width, height); None leaves the camera's own. Of
    several classes number `hair` must win; one class is hair where its score, a probability in
    [0, 1] or else a logit, says more than even. Raises `NetworkError` where the file is not a
    network.
    """

    file: str
    size: tuple[int, int] | None = None
    hair: int = 1
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def hair_pixels(self, image: AnyFloats) -> Bools:
        """The hair's pixels `(H, W)` of a scene-linear picture `(H, W, 3)`; raises as above."""
        height, width = image.shape[:2]
        picture = cv2.resize(
            _srgb(image), self.size or (width, height), interpolation=cv2.INTER_AREA
        )
        planes = ((picture - self.mean) / self.std).transpose(2, 0, 1)[None].astype(np.float32)
        self._net.setInput(np.ascontiguousarray(planes))
        try:
            scores = np.asarray(self._net.forward())
        except cv2.error as error:
            raise NetworkError(
                f"{self.file}: does not take a picture {planes.shape}: {error.err}; give the size "
                "(width, height) that it was made for"
            ) from error
        if scores.ndim != 4 or scores.shape[0] != 1 or not np.isfinite(scores).all():
            raise NetworkError(
                f"{self.file}: expected finite scores (1, classes, h, w), got {scores.shape}"
            )
        if scores.shape[1] > 1 and not 0 <= self.hair < scores.shape[1]:
            raise NetworkError(
                f"{self.file}: hair is class {self.hair}, but it tells {scores.shape[1]} classes"
            )
        # scores are enlarged, not masks: the edge stays smooth
        planes = [cv2.resize(s, (width, height)) for s in scores[0]]
        if len(planes) > 1:
            return np.asarray(np.argmax(planes, axis=0) == self.hair)
        probability = scores.min() >= 0 and scores.max() <= 1
        return np.asarray(planes[0] > (0.5 if probability else 0.0))

    def to_dict(self) -> dict[str, Any]:
        """What a report says of it: the file, and its SHA-256."""
        return {
            "file": self.file,
            "sha256": hashlib.sha256(Path(self.file).read_bytes()).hexdigest(),
        }

    @cached_property
    def _net(self) -> Any:
        if not Path(self.file).is_file():
            raise NetworkError(f"{self.file}: no such file; expected an ONNX network")
        try:
            return cv2.dnn.readNetFromONNX(self.file)
        except cv2.error as error:
            raise NetworkError(f"{self.file}: not an ONNX network ({error.err})") from error


def _srgb(image: AnyFloats) -> Array:
    """Exposed to a white of the 99th percentile, display-coded (IEC 61966-2-1)."""
    white = float(np.percentile(image, 99))
    linear = np.clip(image / white, 0, 1) if white > 0 else np.zeros(image.shape)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
