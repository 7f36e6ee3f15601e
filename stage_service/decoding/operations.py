"""Operations of the decoder's process: each takes a file and returns JSON and bytes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
from numpy.typing import NDArray

from reconstruction.containment import plain_file
from reconstruction.files.exr import read_exr, window_size
from reconstruction.files.masks import read_mask
from reconstruction.files.radiance import hdr_size
from reconstruction.geometry.mesh import read_obj
from stage_service.decoding.frame_pictures import frame_figures, png_of_frame
from stage_service.decoding.framing import Part
from stage_service.decoding.limits import (
    MOST_CHANNELS,
    MOST_FRAME_PIXELS,
    MOST_MAP_PIXELS,
    MOST_TRIANGLES,
)

Response = tuple[dict[str, Any], list[Part]]


def preload() -> None:
    """Load libraries for the forks, without the renderer, which starts threads."""
    from stage_service.decoding import board_views  # noqa: F401

    cv2.setNumThreads(1)


def preview(file: Path, **look: Any) -> Response:
    """A PNG of a frame."""
    _check_exr(file, MOST_FRAME_PIXELS)
    return {}, [png_of_frame(*read_exr(file), **look)]


def figures(file: Path) -> Response:
    """Exposure and sharpness of a frame."""
    _check_exr(file, MOST_FRAME_PIXELS)
    return {"figures": frame_figures(*read_exr(file))}, []


def head(file: Path) -> Response:
    """The triangles of an OBJ: vertices, faces, and the scalp's faces if marked."""
    _check_obj(file, MOST_TRIANGLES)
    mesh = read_obj(file, MOST_TRIANGLES)
    arrays = [mesh.vertices, mesh.faces]
    return _arrays(*arrays, *([] if mesh.scalp is None else [mesh.scalp]))


def mask(file: Path, width: int, height: int) -> Response:
    """Pixels of a grey PNG of that size from half grey on."""
    return _arrays(read_mask(file, width, height))


def map_weights(
    file: Path, kind: str, rotation_deg: float, positions: list[Any], intensities: list[Any]
) -> Response:
    """Weights of lights that represent an environment map of the `kind` "hdr" or "exr"; lights are
    at `positions (L, 3)` with `intensities (L, 3)` towards the origin."""
    if kind == "exr":
        _check_exr(file, MOST_MAP_PIXELS)
    else:
        _check_radiance(file, MOST_MAP_PIXELS)

    from appearance.model.light_sums import weights_of_environment
    from appearance.render.environment_maps import load_environment
    from reconstruction import Light

    lights = [
        Light(f"light {i}", np.array(p), np.array(power))
        for i, (p, power) in enumerate(zip(positions, intensities, strict=True))
    ]
    image = load_environment(file, kind)
    return _arrays(weights_of_environment(lights, image, rotation_deg))


def board(file: Path, **options: Any) -> Response:
    """The board in a camera's lit frame of the capture at `file`."""
    from stage_service.decoding.board_views import board_view

    return {"board": board_view(file, **options)}, []


OPERATIONS: dict[str, Callable[..., Response]] = {
    f.__name__: f for f in (preview, figures, head, mask, map_weights, board)
}


def _arrays(*arrays: NDArray[Any]) -> Response:
    whole = [np.ascontiguousarray(a) for a in arrays]
    described = [{"dtype": a.dtype.str, "shape": a.shape} for a in whole]
    return {"arrays": described}, [memoryview(a).cast("B") if a.size else b"" for a in whole]


def _check_exr(file: Path, most: int) -> None:
    """Raise `ValueError` if an OpenEXR file unpacks to more than `most` pixels."""
    plain_file(file)
    try:
        headers = [part.header for part in OpenEXR.File(str(file), header_only=True).parts]
        windows = [window_size(h[n]) for h in headers for n in ("dataWindow", "displayWindow")]
        channels = sum(len(header["channels"]) for header in headers)
    except Exception as error:  # the binding raises various classes
        raise ValueError(f"{file}: cannot be read as OpenEXR ({error})") from error
    for size in windows:
        _check_size(file, *size, most)
    if channels > MOST_CHANNELS:
        raise ValueError(f"{file}: {channels} channels; at most {MOST_CHANNELS} are read")
    if any("deep" in str(header.get("type", "")) for header in headers):
        raise ValueError(f"{file}: has deep samples: write it without them")


def _check_radiance(file: Path, most: int) -> None:
    """The same of a Radiance file."""
    _check_size(file, *hdr_size(file), most)


def _check_obj(file: Path, most: int) -> None:
    """Raise `ValueError` if an OBJ file has more than `most` faces."""
    faces, last = 0, b"\n"
    with plain_file(file).open("rb") as opened:
        while chunk := opened.read(1 << 20):
            faces += (last + chunk).count(b"\nf")
            last = chunk[-1:]
    if faces > most:
        raise ValueError(
            f"{file}: {faces:,} faces; at most {most:,} are read: make the mesh coarser"
        )


def _check_size(file: Path, width: int, height: int, most: int) -> None:
    """Raise `ValueError` for more than `most` pixels."""
    if width < 1 or height < 1 or width * height > most:
        raise ValueError(
            f"{file}: the image unpacks to {width} × {height} pixels; at most {most:,} are read"
        )
