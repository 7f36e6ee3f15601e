"""Writers of the camera formats, from each format's description; they share nothing with us.

All take cameras in our convention: K with the centre of the top-left pixel at (0, 0).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from reconstruction import Camera


def quaternion(R: np.ndarray) -> np.ndarray:
    """(w, x, y, z) as the eigenvector of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = R
    K = np.array(
        [
            [a - e - i, d + b, g + c, h - f],
            [d + b, e - a - i, h + f, c - g],
            [g + c, h + f, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    x, y, z, w = np.linalg.eigh(K)[1][:, -1]
    return np.array([w, x, y, z])


def colmap_params(camera: Camera) -> list[float]:
    """FULL_OPENCV: fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6; its pixels' centres are at .5."""
    k1, k2, p1, p2, k3 = camera.distortion
    K = camera.K
    return [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, k1, k2, p1, p2, k3, 0, 0, 0]


def write_colmap_text(folder: Path, cameras: Sequence[Camera]) -> None:
    folder.mkdir(parents=True)
    lines = ["# Camera list with one line of data per camera:"]
    images = ["# Image list with two lines of data per image:", "# POINTS2D[] as (X, Y, ID)"]
    for i, camera in enumerate(cameras):
        params = " ".join(repr(float(p)) for p in colmap_params(camera))
        lines.append(f"{10 + i} FULL_OPENCV {camera.width} {camera.height} {params}")
        pose = " ".join(repr(float(v)) for v in (*quaternion(camera.R), *camera.t))
        images.append(f"{i + 1} {pose} {10 + i} {camera.name}.jpg")
        images.append("12.5 3.25 -1 7.0 8.0 5" if i % 2 else "")
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    (folder / "images.txt").write_text("\n".join(images) + "\n")


def write_colmap_binary(folder: Path, cameras: Sequence[Camera]) -> None:
    folder.mkdir(parents=True)
    data = struct.pack("<Q", len(cameras))
    images = struct.pack("<Q", len(cameras))
    for i, camera in enumerate(cameras):
        data += struct.pack("<iiQQ", i, 6, camera.width, camera.height)
        data += struct.pack("<12d", *colmap_params(camera))
        images += struct.pack("<i7di", i, *quaternion(camera.R), *camera.t, i)
        images += f"{camera.name}.png".encode() + b"\0"
        images += struct.pack("<Q", 2) + 2 * struct.pack("<ddq", 1.0, 2.0, -1)
    (folder / "cameras.bin").write_bytes(data)
    (folder / "images.bin").write_bytes(images)


def write_transforms(path: Path, cameras: Sequence[Camera]) -> None:
    """nerfstudio: camera to world, x right, y up, z backwards."""
    frames = []
    for camera in cameras:
        right, down, forward = camera.R
        matrix = np.eye(4)
        matrix[:3] = np.stack([right, -down, -forward, camera.center], axis=1)
        k1, k2, p1, p2, k3 = camera.distortion
        frame = {"file_path": f"images/{camera.name}.png", "transform_matrix": matrix.tolist()}
        frame |= {"w": camera.width, "h": camera.height}
        frame |= {"fl_x": camera.K[0, 0], "fl_y": camera.K[1, 1]}
        frame |= {"cx": camera.K[0, 2] + 0.5, "cy": camera.K[1, 2] + 0.5}
        frames.append(frame | {"k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3})
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"camera_model": "OPENCV", "frames": frames}))
