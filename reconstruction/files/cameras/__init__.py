"""Camera files of COLMAP, Metashape, nerfstudio, OpenCV, EasyMocap and The Captury.

    file = read_cameras("sparse/0")
    file.cameras, file.notes

Camera axes and pixel centres are converted; units and world axes remain the file's, see
`reconstruction.geometry.placement`.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from reconstruction.containment import plain_file
from reconstruction.files.cameras.captury import read_calib
from reconstruction.files.cameras.colmap import read_colmap
from reconstruction.files.cameras.errors import CameraFile, CameraFileError
from reconstruction.files.cameras.metashape import read_metashape
from reconstruction.files.cameras.nerfstudio import read_transforms
from reconstruction.files.cameras.opencv import (
    EASYMOCAP,
    SUFFIXES,
    cameras_from,
    read_easymocap,
    read_opencv,
    read_opencv_folder,
)
from reconstruction.reading import read_json

__all__ = ["CameraFile", "CameraFileError", "read_cameras"]

_KNOWN = (
    "a COLMAP model (cameras and images, .txt or .bin), transforms.json, Metashape's .xml, "
    "OpenCV's .yml or .xml, EasyMocap's intri.yml and extri.yml, a map of cameras in .json, .calib"
)


def read_cameras(path: str | Path) -> CameraFile:
    """The cameras of a file or folder in any of the formats. Raises `CameraFileError`."""
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
        return _read_folder(path)
    if path.name in ("cameras.txt", "images.txt", "cameras.bin", "images.bin"):
        return read_colmap(path.parent, path.suffix)
    if path.name in EASYMOCAP and all((path.parent / name).is_file() for name in EASYMOCAP):
        return read_easymocap(path.parent)
    if not path.exists():
        raise CameraFileError(f"{path}: no such file or folder")
    if path.suffix == ".json":
        return _read_json(path)
    if path.suffix == ".xml":
        root = _root(path)
        return read_opencv(path) if root.tag == "opencv_storage" else read_metashape(path, root)
    if path.suffix in SUFFIXES:
        return read_opencv(path)
    if path.suffix == ".calib":
        return read_calib(path)
    raise CameraFileError(f"{path}: unknown format; expected {_KNOWN}")


def _read_folder(path: Path) -> CameraFile:
    for folder in (path, path / "0", path / "sparse" / "0", path / "sparse"):
        if (folder / "cameras.txt").is_file() or (folder / "cameras.bin").is_file():
            return read_colmap(folder)
    if (path / "transforms.json").is_file():
        return _read(path / "transforms.json")
    if all((path / name).is_file() for name in EASYMOCAP):
        return read_easymocap(path)
    if files := sorted(f for f in path.iterdir() if f.suffix in SUFFIXES):
        return read_opencv_folder(path, files)
    raise CameraFileError(f"{path}: no camera file found; expected {_KNOWN}")


def _read_json(path: Path) -> CameraFile:
    data = read_json(path)
    if isinstance(data, dict) and "frames" in data:
        return read_transforms(path, data)
    if isinstance(data, dict):
        return cameras_from(path, data)
    raise CameraFileError(f"{path}: expected an object with 'frames' or a map for each camera")


def _root(path: Path) -> ElementTree.Element:
    try:
        return ElementTree.fromstring(plain_file(path).read_bytes())
    except (ElementTree.ParseError, LookupError) as error:  # LookupError: no such encoding
        raise CameraFileError(f"{path}: broken XML ({error})") from error
