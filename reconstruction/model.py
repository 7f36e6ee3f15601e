"""A model: the folder with all results from one capture, and the only code that joins its paths.

Files are written durably: after a crash each is the old one or the new one.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Array, Bools
from reconstruction.capture.folder import Capture
from reconstruction.files.durable import PART, write_json, writing
from reconstruction.files.numpy_files import read_arrays
from reconstruction.files.strands import read_strands, write_strands
from reconstruction.geometry.mesh import Mesh, read_obj, write_obj
from reconstruction.geometry.strands import Strands
from reconstruction.geometry.world_frame import WorldFrame
from reconstruction.light_planes.point_cloud import PointCloud
from reconstruction.options import BadOptions
from reconstruction.reading import read_json
from reconstruction.report.report import Report

MaskKind = Literal["hair", "skin"]

FILES = {
    "index.html": "one page on the model: start here",
    "strands.npz": "the strands, roots first (also .hair and .usdc)",
    "strands.hair": "the strands for cyHair's readers",
    "strands.usdc": "the strands as USD curves",
    "points.npz": "the triangulated points",
    "frame.json": "unit, up axis and origin of an imported capture's world, which strands and head "
    "are in",
    "head.obj": "the fitted head, if the capture has none",
    "scalp_map.npz": "the roots' coordinates on the flat map of the scalp",
    "masks": "masks of hair and skin of every camera, in the pixels of its frames",
    "appearance.json": "the hair as one material, skin, exposure (Sun's fit)",
    "hair_maps.npz": "the hair's material over the scalp (inverse rendering)",
    "lights.json": "light intensities, axes and lobes fitted by inverse rendering",
    "field.npz": "modulation or additive field on top of the material",
    "samples": "captured frames by camera, for interpolation",
    "comparison.png": "held-out frames, captured and rendered",
    "relit.png": "the hair under an environment map",
    "relit.exr": "the same as linear radiance",
    "relit.webp": "the same under a rotating environment (job option assess.turning_frames)",
    "render.png": "the last image of `hairstage render`",
    "render.webp": "the last animation of `hairstage render`",
    "report.json": "every stage: seconds, figures, error against run time, warnings",
    "plots": "the report's plots",
    "results.json": "the job's figures in one object",
    "progress.json": "the current stage of a running job",
}
"""The files of a model folder, without the checkpoints of a running fit."""


_OF_APPEARANCE = (
    "index.html",
    "appearance.json",
    "hair_maps.npz",
    "lights.json",
    "field.npz",
    "comparison.png",
    "relit.png",
    "relit.exr",
    "relit.webp",
    "render.png",
    "render.webp",
    "plots",
    "results.json",
)
_RECONSTRUCT = "hairstage reconstruct CAPTURE --out"


class ModelError(ValueError):
    """A missing or damaged file of a model; the message names the file and the command to run."""


class Model:
    """A model folder, which may not exist yet: see `create`."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def __str__(self) -> str:
        return str(self.path)

    def create(self) -> Model:
        """Create the folder if needed; returns the model."""
        (self.path / "masks").mkdir(parents=True, exist_ok=True)
        return self

    def file(self, name: str) -> Path:
        """The path of one of `FILES`, or of a file in one that is a folder."""
        if name.split("/")[0] not in FILES:
            raise KeyError(f"a model has no file {name!r}; there are {', '.join(FILES)}")
        return self.path / name

    def has(self, name: str) -> bool:
        """Whether the file exists."""
        return self.file(name).exists()

    def remove(self, name: str) -> None:
        """Remove a file, or a folder of files, if it exists."""
        path = self.file(name)
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)

    def forget_appearance(self) -> None:
        """Remove every fit to the strands, with its images and figures."""
        for name in _OF_APPEARANCE:
            self.remove(name)

    @contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """A temporary path to write the file `name` to; see `durable.writing`."""
        path = self.file(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        with writing(path) as temporary:
            yield temporary

    def artifacts(self) -> dict[str, Path]:
        """The complete files by their names relative to the folder, in order."""
        root = self.path.resolve()
        return {p.relative_to(root).as_posix(): p for p in sorted(_complete_files(root, root))}

    def sizes(self) -> dict[str, int]:
        """Bytes of `artifacts` by their names, without those that a job removes meanwhile."""
        sizes = {}
        for name, path in self.artifacts().items():
            with suppress(FileNotFoundError):
                sizes[name] = path.stat().st_size
        return sizes

    @property
    def frame(self) -> WorldFrame | None:
        """The user's frame, which the files of strands and head are in; None for the stage's."""
        if not self.has("frame.json"):
            return None
        try:
            return WorldFrame.from_dict(self.json("frame.json"), str(self.file("frame.json")))
        except (TypeError, BadOptions) as error:
            raise ModelError(f"{self.file('frame.json')}: {error}") from error

    def start(self, frame: WorldFrame | None) -> None:
        """Let strands and head be written in `frame`; removes those in another one."""
        record = None if frame is None else frame.to_dict()
        if record == (self.json("frame.json") if self.has("frame.json") else None):
            return
        for name in ("strands.npz", "strands.hair", "strands.usdc", "head.obj", "frame.json"):
            self.remove(name)
        if record is not None:
            self.write_json("frame.json", record)

    def strands(self) -> Strands:
        """The strands, in the stage's frame. Raises `ModelError` without any."""
        return read_strands(self._needed("strands.npz", _RECONSTRUCT), frame=self.frame)

    def write_strands(self, strands: Strands) -> None:
        """Write the strands in all three formats, after removing results from earlier ones."""
        self.forget_appearance()
        self.remove("scalp_map.npz")
        for suffix in ("npz", "hair", "usdc"):
            write_strands(self.file(f"strands.{suffix}"), strands, self.frame)

    def points(self) -> PointCloud:
        """The triangulated points; empty without a sweep."""
        return PointCloud.load(self._needed("points.npz", _RECONSTRUCT))

    def write_points(self, points: PointCloud) -> None:
        """Write the triangulated points."""
        points.save(self.file("points.npz"))

    def head(self, capture: Capture | None) -> Mesh | None:
        """The head that later steps use: the fitted one, else the capture's."""
        if self.has("head.obj"):
            head, frame = read_obj(self.file("head.obj")), self.frame
            return head if frame is None else frame.inputs(head)
        return capture.head if capture is not None else None

    def write_head(self, head: Mesh) -> None:
        """Write the fitted head."""
        with self.writing("head.obj") as temporary:
            write_obj(temporary, head if self.frame is None else self.frame.results(head))

    def mask(self, camera: str, kind: MaskKind, capture: Capture) -> Bools:
        """The mask `(H, W)` of `camera`, in the pixels of `capture`'s frames.

        A missing hair mask falls back to the user's in the capture, a missing skin mask to an empty
        one. Raises `CaptureError` for a mask of another size, `ModelError` without a hair mask.
        """
        name = f"masks/{camera}_{kind}.png"
        if not self.has(name):
            if kind == "skin":
                size = capture.rig.camera(camera)
                return np.zeros((size.height, size.width), bool)
            user = capture.mask(camera)
            if user is not None:
                return user
        return capture.read_mask(self._needed(name, _RECONSTRUCT), camera)

    def write_mask(self, camera: str, kind: MaskKind, mask: Bools) -> None:
        """Write a mask `(H, W)`, in the pixels of the frames on disk."""
        self.write_png(f"masks/{camera}_{kind}.png", mask.astype(np.uint8) * 255)

    def write_png(self, name: str, image: NDArray[np.uint8]) -> None:
        """Write a grey `(H, W)` or BGR `(H, W, 3)` image."""
        with self.writing(name) as temporary:
            if not cv2.imwrite(str(temporary), image):
                raise OSError(f"{self.file(name)}: OpenCV could not write it")

    def arrays(self, name: str) -> dict[str, NDArray[Any]]:
        """The arrays of an `.npz` file by name; `ModelError` if it is missing or damaged."""
        file = self._needed(name, "hairstage fit CAPTURE")
        try:
            return read_arrays(file)
        except ValueError as error:
            raise ModelError(f"{file}: {error}: run 'hairstage fit' again") from error

    def write_arrays(self, name: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write arrays as a compressed `.npz` file."""
        with self.writing(name) as temporary:
            np.savez_compressed(temporary, allow_pickle=False, **arrays)

    def root_uv(self, strands: Strands) -> Array | None:
        """(u, v) of each strand's root on the scalp's map `(S, 2)`; None without a map."""
        if not self.has("scalp_map.npz"):
            return None
        try:
            roots = np.asarray(self.arrays("scalp_map.npz")["roots"], float)
        except KeyError as error:
            raise ModelError(f"{self.file('scalp_map.npz')}: {error} is missing") from error
        return np.clip(roots, 0, 1) if len(roots) == len(strands) else None

    def json(self, name: str) -> Any:
        """A JSON file. Raises `ModelError` if it is missing or not JSON."""
        try:
            return read_json(self._needed(name, "hairstage fit CAPTURE"))
        except ModelError:
            raise
        except ValueError as error:
            raise ModelError(str(error)) from error

    def write_json(self, name: str, data: Any, *, durable: bool = True) -> None:
        """Write JSON; numbers that are not finite are an error."""
        self.path.mkdir(parents=True, exist_ok=True)
        write_json(self.file(name), data, durable=durable)

    def report(self) -> Report:
        """The report of all stages so far, empty without any."""
        return Report.load(self.file("report.json"))

    def write_report(self, report: Report) -> None:
        """Write the report."""
        self.write_json("report.json", report.to_dict())

    def checkpoint(self, variant: str) -> Path:
        """The state of a running fit of this variant."""
        return self.path / f"inverse_rendering-{variant}.checkpoint.npz"

    def work(self, name: str) -> Path:
        """Temporary files of the running step of this name."""
        return self.path / "work" / name

    def _needed(self, name: str, command: str) -> Path:
        path = self.file(name)
        if not path.exists() and (self.path / "rig.json").exists():
            raise ModelError(
                f"{self.path} is a capture, not a model: run 'hairstage reconstruct {self.path} "
                "--out MODEL' first"
            )
        if not path.exists():
            raise ModelError(f"{path} is missing: run '{command} {self.path}' first")
        return path


def _complete_files(folder: Path, root: Path) -> Iterator[Path]:
    """The files below a folder that are written to their end; links only if they stay in `root`."""
    with suppress(FileNotFoundError), os.scandir(folder) as entries:
        for entry in entries:
            path = Path(entry.path)
            if entry.is_dir(follow_symlinks=False):
                yield from _complete_files(path, root)
            elif entry.name.startswith(PART) or not entry.is_file():
                continue
            elif not entry.is_symlink() or path.resolve().is_relative_to(root):
                yield path
