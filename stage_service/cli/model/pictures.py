"""Pictures for `evaluate images`: read, expose, compare."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from appearance import Exposure, psnr, ssim
from reconstruction import read_exr
from reconstruction.arrays import Array, Bools

SUFFIXES = (".png", ".jpg", ".jpeg", ".exr")


def pair_up(pred: Path, true: Path) -> list[tuple[str, Path, Path]]:
    """(name, predicted, true) for two files, or for the names that two folders share."""
    for path in (pred, true):
        if not path.exists():
            raise ValueError(f"{path}: no such picture or folder")
    if pred.is_dir() != true.is_dir():
        raise ValueError(f"compare two files or two folders, got {pred} and {true}")
    if not pred.is_dir():
        return [(pred.name, pred, true)]
    names = {p.name for p in true.iterdir() if p.suffix.lower() in SUFFIXES}
    return [(p.name, p, true / p.name) for p in sorted(pred.iterdir()) if p.name in names]


def compare_pictures(pred: Path, true: Path, mask: Path | None) -> dict[str, float]:
    """PSNR in dB and SSIM of one picture against another, over the mask where there is one.

    EXR files are linear: both get the exposure that takes the 99th percentile of the true pixels
    to 1, then the sRGB curve. Other files are taken as sRGB. Raises `ValueError`.
    """
    if (pred.suffix.lower() == ".exr") != (true.suffix.lower() == ".exr"):
        raise ValueError(f"{pred} and {true}: compare two EXR files or two sRGB pictures")
    linear = pred.suffix.lower() == ".exr"
    a, b = (read_exr(p)[0] if linear else _picture(p) for p in (pred, true))
    for path, image in ((pred, a), (true, b)):
        if not np.isfinite(image).all():
            raise ValueError(f"{path}: {(~np.isfinite(image)).sum()} of its values are not finite")
    hair = _mask(mask)
    if hair is not None and (hair.shape != b.shape[:2] or not hair.any()):
        raise ValueError(
            f"{mask}: a mask must mark pixels of {true}, {b.shape[:2]}, got {hair.shape} with "
            f"{hair.sum()} marked"
        )
    if linear:
        lit = np.percentile(b if hair is None else b[hair], 99)
        if not lit > 0:
            raise ValueError(f"{true}: under one pixel in a hundred is lit: it cannot be exposed")
        a, b = (Exposure(1 / float(lit))(x) for x in (a, b))
    return {"psnr": psnr(a, b, hair), "ssim": ssim(a, b, hair)}


def _picture(path: Path) -> Array:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if image is None:
        raise ValueError(f"{path}: not a picture that can be read")
    if image.dtype.kind != "u":
        raise ValueError(f"{path}: linear pictures are compared as .exr, others have 8 or 16 bits")
    return np.asarray(image, np.float64) / np.iinfo(image.dtype).max


def _mask(path: Path | None) -> Bools | None:
    if path is None:
        return None
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ValueError(f"{path}: not a picture that can be read")
    return np.asarray(image >= 128)
