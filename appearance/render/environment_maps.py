"""Environment maps: the project's own procedural ones, and readers for the user's."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reconstruction import read_exr
from reconstruction.arrays import AnyFloats, Array, Floats
from reconstruction.files.radiance import read_hdr

BRIGHTEST = 1e25
"""Radiance, or a light's intensity, up to which sums over paths stay finite in float32."""


def load_environment(path: str | Path, kind: str | None = None) -> Floats:
    """Read a lat-long map `(h, w, 3)`, scene-linear RGB, from Radiance `.hdr` or OpenEXR `.exr`;
    `kind` is "hdr" or "exr" where the path does not end so.

    Raises `ValueError` that names the file when it is absent, of another kind, negative or not
    finite.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such environment map")
    kind = kind or path.suffix.lower().removeprefix(".")
    if kind == "exr":
        return check_environment(read_exr(path)[0], str(path))
    if kind != "hdr":
        raise ValueError(f"{path}: an environment map must be .hdr or .exr")
    return check_environment(read_hdr(path), str(path))


def check_environment(envmap: AnyFloats, name: str) -> Floats:
    """`envmap` as float32; `ValueError` unless `(h, w, 3)` and in [0, `BRIGHTEST`]."""
    image = np.asarray(envmap)
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"{name}: expected a map of shape (h, w, 3), got {image.shape}")
    wrong = ~((image >= 0) & (image <= BRIGHTEST))
    if wrong.any():
        row, column, channel = np.argwhere(wrong)[0]
        raise ValueError(
            f"{name}: radiance must be finite and not negative, {BRIGHTEST:g} at most, but "
            f"{int(wrong.sum())} values are not, the first at row {row}, column {column}: "
            f"{image[row, column, channel]}"
        )
    return np.asarray(image, np.float32)


def subdivided(envmap: AnyFloats, rows: int) -> AnyFloats:
    """The same light as `envmap (h, w, 3)` in a map of at least `rows` rows, 2 `rows` columns.

    Texels are as bright all over, and large ones shine from many directions.
    """
    height, width = envmap.shape[:2]
    fine = envmap.repeat(max(1, -(-rows // height)), axis=0)
    return fine.repeat(max(1, -(-2 * rows // width)), axis=1)


def studio(height: int = 128) -> Floats:
    """A dim grey room `(h, 2 h, 3)` with key, cool fill and warm rim; `height` is h.

    The key is in front of a subject that faces −y, high on its right; mean radiance about 1.
    """
    direction = _directions(height)
    image = np.empty((height, 2 * height, 3), np.float32)
    image[:] = (0.08 + 0.06 * np.clip(direction[..., 2:] + 0.5, 0, 1)) * np.array([1, 1, 1.05])
    for middle, half, colour in (
        ((-125.0, 38.0), (22.0, 18.0), (22.0, 20.5, 18.5)),
        ((-40.0, 12.0), (26.0, 30.0), (2.2, 2.6, 3.2)),
        ((75.0, 42.0), (12.0, 20.0), (26.0, 22.0, 17.0)),
    ):
        box = _soft_box(direction, middle, half)[..., None]
        image += box * np.array(colour, np.float32)
    return image


def sky(
    height: int = 128, sun_azimuth_deg: float = -120.0, sun_elevation_deg: float = 40.0
) -> Floats:
    """A clear sky `(h, 2 h, 3)`, a sun 4° wide, over grey ground; `height` is h.

    A gradient from a pale horizon to a blue zenith with a glow about the sun; not a physical sky
    model. Azimuth in the world's frame, from +x towards +y.
    """
    direction = _directions(height)
    up = direction[..., 2:]
    horizon, zenith = np.array([0.9, 0.95, 1.0]), np.array([0.18, 0.34, 0.75])
    image = horizon + (zenith - horizon) * np.sqrt(np.clip(up, 0, 1))
    cosine = (direction * _unit(sun_azimuth_deg, sun_elevation_deg)).sum(-1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    warm = np.array([1.0, 0.92, 0.8])
    image = image + 1.5 * warm * np.exp(-angle / 12.0)
    image = np.where(up < 0, np.array([0.16, 0.15, 0.13]), image)
    image = image + 900.0 * warm * np.clip(2.0 - angle + 0.5, 0, 1)
    return image.astype(np.float32)


def _directions(height: int) -> Array:
    """Unit directions `(height, 2 height, 3)` of the texels' centres; see `render.environment`."""
    if height < 2:
        raise ValueError(f"an environment map needs at least 2 rows, got {height}")
    theta = np.pi * (np.arange(height) + 0.5)[:, None] / height
    phi = 2 * np.pi * (0.5 - (np.arange(2 * height) + 0.5) / (2 * height))
    z = np.broadcast_to(np.cos(theta), (height, 2 * height))
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), z], axis=-1)


def _unit(azimuth_deg: float, elevation_deg: float) -> Array:
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def _soft_box(
    direction: Array, middle_deg: tuple[float, float], half_deg: tuple[float, float]
) -> Floats:
    """Share `(h, w)` of a rectangle (azimuth, elevation) on the sphere, its edge soft over 2°."""
    elevation = np.degrees(np.arcsin(np.clip(direction[..., 2], -1, 1)))
    azimuth = np.degrees(np.arctan2(direction[..., 1], direction[..., 0]))
    across = np.abs((azimuth - middle_deg[0] + 180) % 360 - 180)
    along = np.abs(elevation - middle_deg[1])
    edge_x, edge_y = (
        np.clip((half - off) / 2 + 0.5, 0, 1)
        for half, off in zip(half_deg, (across, along), strict=True)
    )
    return (edge_x * edge_y).astype(np.float32)


PROCEDURAL = {"studio": studio, "sky": sky}


def environment_map(name: str) -> Floats:
    """The map `(H, W, 3)` "studio" or "sky", or that of an `.hdr` or `.exr` file."""
    return PROCEDURAL[name]() if name in PROCEDURAL else load_environment(Path(name))
