"""A contact sheet of an import: cameras down, steps across."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reconstruction.capture.exposures import Merged
from reconstruction.capture.import_folder import Import
from reconstruction.capture.records import Step
from reconstruction.files.durable import write_whole

CELL, MOST_STEPS, MOST_CAMERAS = 160, 8, 24
RED, GREEN, BLUE = (40, 40, 230), (80, 200, 80), (230, 150, 60)


def contact_sheet(understood: Import, out: Path) -> None:
    """Write a PNG with a few steps of each kind for each camera, at one exposure per camera.

    Saturated pixels are red, hair is outlined in green, the subject in blue, missing frames are
    crossed. Raises `ImportProblem` for an image that cannot be read.
    """
    steps = _chosen(understood.found.steps)
    cameras = list(understood.shot)[:MOST_CAMERAS]
    rows = []
    for camera in cameras:
        frames = {}
        for step in steps:
            if bracket := understood.found.frames.get((step.index, camera)):
                frames[step] = understood.frames.frame(bracket, camera)
        lit = [f.radiance for s, f in frames.items() if s.kind == "olat"] or [
            f.radiance for f in frames.values()
        ]
        white = max((float(np.percentile(x, 99.5)) for x in lit), default=1.0)
        outlines = understood.masks(camera)
        cells = [_cell(frames.get(s), white, outlines, _name(s)) for s in steps]
        rows.append(np.hstack([_label(camera), *cells]))
    done, png = cv2.imencode(".png", np.vstack(rows))
    assert done
    write_whole(out, png.tobytes())


def _chosen(steps: tuple[Step, ...]) -> list[Step]:
    """One of each other kind, the rest single lights from first to last."""
    others = [
        s for kind in ("dark", "all_on", "tracking", "scanline") for s in _of(steps, kind)[:1]
    ]
    single = [s for s in steps if s.lighting is not None]
    at = np.linspace(0, len(single) - 1, min(MOST_STEPS - len(others), len(single)))
    return [*others, *(single[round(i)] for i in at)]


def _of(steps: tuple[Step, ...], kind: str) -> list[Step]:
    return [s for s in steps if s.kind == kind]


def _name(step: Step) -> str:
    if step.kind == "scanline":
        return f"{step.projector} {step.row}"
    return step.lighting or step.kind


def _cell(
    frame: Merged | None,
    white: float,
    outlines: tuple[NDArray[Any] | None, NDArray[Any] | None],
    name: str,
) -> NDArray[Any]:
    """One small image with its name."""
    if frame is None:
        out = np.full((CELL, CELL, 3), 30, np.uint8)
        cv2.line(out, (0, 0), (CELL, CELL), RED, 1)
        cv2.line(out, (0, CELL), (CELL, 0), RED, 1)
        return _titled(out, f"{name} missing")
    share = np.clip(frame.radiance[..., ::-1] / max(white, 1e-12), 0, 1) ** (1 / 2.2)
    height, width = share.shape[:2]
    scale = (CELL - 2) / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize((255 * share).astype(np.uint8), size, interpolation=cv2.INTER_AREA)
    small[_small(frame.saturated, size) > 0] = RED
    for mask, colour in zip(outlines, (GREEN, BLUE), strict=True):
        if mask is not None:
            shape = (_small(mask, size) >= 128).astype(np.uint8)
            lines = cv2.findContours(shape, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
            cv2.drawContours(small, lines, -1, colour, 1)
    out = np.zeros((CELL, CELL, 3), np.uint8)
    out[: size[1], : size[0]] = small
    return _titled(out, name)


def _small(mask: NDArray[Any], size: tuple[int, int]) -> NDArray[Any]:
    grey = mask.astype(np.uint8) * 255
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA))


def _label(text: str) -> NDArray[Any]:
    return _titled(np.zeros((CELL, CELL // 2, 3), np.uint8), text)


def _titled(image: NDArray[Any], text: str) -> NDArray[Any]:
    cv2.rectangle(image, (0, image.shape[0] - 14), (image.shape[1], image.shape[0]), (0, 0, 0), -1)
    place = (2, image.shape[0] - 4)
    cv2.putText(image, text[:24], place, cv2.FONT_HERSHEY_PLAIN, 0.8, (255, 255, 255))
    return image
