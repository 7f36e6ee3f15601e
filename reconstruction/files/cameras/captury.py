"""`cameras.calib`, "tc camera calibration", of The Captury's tools and HumanOLAT.

For each camera `origin`, `up` and `right` in the world, millimetres; the focal length and the
principal point's offset from the middle as shares of the sensor size, independent of pixels.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reconstruction.files.cameras.errors import CameraFile, CameraFileError, camera_of, pinhole_K
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lens_models import LensModel
from reconstruction.reading import read_text

HEAD = "tc camera calibration"
WIDTH = 4096
"""Image width of the returned cameras: `resized` scales them to the images."""


def read_calib(path: Path) -> CameraFile:
    """The cameras, `Cam01` and on, through a sensor of `WIDTH` pixels; millimetres.

    The distortion is OpenCV's k1, k2, p2, p1, k3. Raises `CameraFileError`.
    """
    lines = read_text(path).splitlines()
    if not lines or not lines[0].startswith(HEAD):
        raise CameraFileError(f"{path}: does not begin with {HEAD!r}")
    blocks: list[dict[str, list[str]]] = []
    for line in lines[1:]:
        words = line.split("#", 1)[0].split()
        if words[:1] == ["camera"]:
            blocks.append({})
        elif words and blocks:
            blocks[-1].setdefault(words[0], words[1:])
    if not blocks:
        raise CameraFileError(f"{path}: has no camera")
    return CameraFile([_camera(path, i, b) for i, b in enumerate(blocks)], [], 0.001)


def _camera(path: Path, i: int, block: dict[str, list[str]]) -> Camera:
    name = f"Cam{i + 1:02d}"
    where = f"{path}: {name}"

    def numbers(field: str, count: int) -> list[float]:
        try:
            values = [float(w) for w in block[field]]
        except KeyError:
            raise CameraFileError(f"{where}: the field {field!r} is missing") from None
        except ValueError as error:
            raise CameraFileError(f"{where}: {field}: {error}") from error
        if len(values) < count:
            raise CameraFileError(f"{where}: {field} needs {count} numbers, got {len(values)}")
        return values[:count]

    wide, high = numbers("sensorSize", 2)
    aspect, f = numbers("pixelAspect", 1)[0], numbers("focalLength", 1)[0]
    offset = numbers("centerOffset", 2)
    if not (wide > 0 and high > 0):
        raise CameraFileError(f"{where}: sensorSize must be positive")
    if not 0.01 < high / wide < 100:
        raise CameraFileError(f"{where}: sensorSize is {wide:g} x {high:g} mm")
    size = WIDTH, round(WIDTH * high / wide)
    fx = WIDTH * f / wide
    K = pinhole_K(
        *(fx, fx * aspect),
        *(s / 2 + s * o / mm for s, o, mm in zip(size, offset, (wide, high), strict=True)),
    )
    right, up = (np.array(numbers(k, 3)) for k in ("right", "up"))
    R = np.stack([right, -up, np.cross(right, -up)])
    U, _, V = np.linalg.svd(R)  # the file has few digits
    k1, k2, p2, p1, k3 = numbers("distortion", 5)
    lens = LensModel("opencv", np.array([k1, k2, p1, p2, k3]))
    return camera_of(where, name, size, K, (U @ V, -(U @ V) @ numbers("origin", 3)), lens)
