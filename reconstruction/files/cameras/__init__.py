"""Cameras as others write them: COLMAP, Metashape, nerfstudio, OpenCV.

    file = read_cameras("sparse/0")
    file.cameras, file.notes

Camera axes and pixel centres become ours; units and the world's axes stay the file's: see
`reconstruction.geometry.placement`.
"""

from __future__ import annotations

from pathlib import Path

from reconstruction.files.cameras.colmap import read_colmap
from reconstruction.files.cameras.errors import CameraFile, CameraFileError
from reconstruction.files.cameras.nerfstudio import read_transforms
from reconstruction.reading import read_json

__all__ = ["CameraFile", "CameraFileError", "read_cameras"]


def read_cameras(path: str | Path) -> CameraFile:
    """The cameras of a file or folder, whichever of the formats it is.

    Raises `CameraFileError` (a `ValueError`) that says what is wrong with it, or that it is none.
    """
    path = Path(path)
    try:
        return _read(path)
    except OSError as error:
        raise CameraFileError(f"{path}: {error.strerror or error}") from error
    except CameraFileError:
        raise
    except ValueError as error:
        raise CameraFileError(str(error)) from error


def _read(path: Path) -> CameraFile:
    if path.is_dir():
        for folder in (path, path / "0", path / "sparse" / "0", path / "sparse"):
            if (folder / "cameras.txt").is_file() or (folder / "cameras.bin").is_file():
                return read_colmap(folder)
        if (path / "transforms.json").is_file():
            return _read(path / "transforms.json")
        raise CameraFileError(f"{path}: neither a COLMAP model nor transforms.json is in it")
    if path.name in ("cameras.txt", "images.txt", "cameras.bin", "images.bin"):
        return read_colmap(path.parent)
    if path.suffix == ".json":
        data = read_json(path)
        if isinstance(data, dict) and "frames" in data:
            return read_transforms(path, data)
        raise CameraFileError(f"{path}: has no 'frames', as transforms.json has")
    if not path.exists():
        raise CameraFileError(f"{path}: no such file or folder")
    raise CameraFileError(
        f"{path}: no format that is known: a COLMAP model (folder), transforms.json"
    )
