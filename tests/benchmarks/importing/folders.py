"""A capture written out as a user would have it: pictures, COLMAP's text, lights in a table."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from reconstruction import Capture, Step, write_exr
from reconstruction.arrays import Array, Bools, Floats
from reconstruction.geometry.cameras import Camera
from reconstruction.images.silhouettes import silhouette

MM = 1000.0
EXPOSURE = 0.02
"""Seconds, of all pictures but the shorter ones of 8 bits."""
BRACKET = (1 / 64, 1 / 8, 1.0)
"""Exposures of 8-bit pictures, of the longest."""
BLACK, WHITE = 512, 16383
"""Counts of a mosaic of 14 bits."""
BLOWN = 0.98
"""The quantile of the hair's pixels under single lights that saturated pictures still hold."""
COLOURS = np.array([[0, 1], [1, 2]])  # RGGB


@dataclass(frozen=True)
class Written:
    """What becomes of a capture as it is written.

    `kind` of the pictures: floats, or whole numbers of 16 bits, of 8 in three exposures and sRGB,
    or of a mosaic's 14. `wall` is the background's radiance as a share of the bright hair's, with
    clean plates beside it; `missing` the share of frames that are not there; `blown` whether the
    exposure is so long that highlights saturate. `head` and `sweep` are left out where False.
    """

    kind: Literal["exr", "png16", "png8", "bayer"] = "exr"
    wall: float = 0.0
    missing: float = 0.0
    blown: bool = False
    head: bool = True
    sweep: bool = True


def write_folder(capture: Capture, folder: Path, written: Written, seed: int = 0) -> Path:
    """Write `capture` to the new `folder`; COLMAP's model and lights count in millimetres.

    `hairstage import FOLDER` reads it: `import.toml` says how.
    """
    folder.mkdir(parents=True)
    write_colmap(capture, folder / "sparse" / "0")
    with (folder / "lights.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(("name", "x", "y", "z", "r", "g", "b"))
        for light in capture.rig.lights:
            place = [f"{MM * x:.3f}" for x in light.position]
            table.writerow((light.name, *place, *map(float, light.intensity)))
    if written.sweep and capture.rig.projectors:
        projectors = capture.rig.to_dict()["projectors"]
        (folder / "projectors.json").write_text(json.dumps({"projectors": projectors}))
    if written.head and (capture.path / "head.obj").is_file():
        shutil.copyfile(capture.path / "head.obj", folder / "head.obj")
    _Pictures(capture, folder, written, np.random.default_rng(seed)).write()
    return folder


def write_colmap(
    capture: Capture, folder: Path, unit: float = MM, picture: str = "{}/all.png"
) -> None:
    """A model in COLMAP's text, whose pixels are centred at halves; lengths times `unit`."""
    folder.mkdir(parents=True)
    cameras, images = [], []
    for k, camera in enumerate(capture.rig.cameras, 1):
        fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2] + 0.5, camera.K[1, 2] + 0.5
        k1, k2, p1, p2 = camera.distortion[:4]
        size = f"{camera.width} {camera.height}"
        cameras.append(f"{k} OPENCV {size} {fx} {fy} {cx} {cy} {k1} {k2} {p1} {p2}\n")
        x, y, z, w = Rotation.from_matrix(camera.R).as_quat()
        t = " ".join(str(v) for v in unit * camera.t)
        images.append(f"{k} {w} {x} {y} {z} {t} {k} {picture.format(camera.name)}\n\n")
    (folder / "cameras.txt").write_text("".join(cameras))
    (folder / "images.txt").write_text("".join(images))


@dataclass(frozen=True)
class _Pictures:
    """Writes the pictures and `import.toml`, which says how they are to be read."""

    capture: Capture
    folder: Path
    written: Written
    rng: np.random.Generator

    def write(self) -> None:
        kinds = {"dark", "all_on", "olat", "tracking"} | (
            {"scanline"} if self.written.sweep else set()
        )
        steps = [
            s
            for s in self.capture.steps
            if s.kind in kinds and (s.kind != "tracking" or self.written.sweep)
        ]
        for camera in self.capture.rig.cameras:
            for step in steps:
                lost = (
                    step.kind in ("olat", "scanline") and self.rng.random() < self.written.missing
                )
                if lost or not self.capture.has(step, camera.name):
                    continue
                self._write_step(step, camera)
        (self.folder / "import.toml").write_text(self._settings())

    def _write_step(self, step: Step, camera: Camera) -> None:
        image = self.capture.frame(step, camera.name)
        lit = step.kind in ("olat", "all_on", "tracking")
        wall = self._wall(image, camera.name) if lit and self.written.wall else None
        if wall is not None:
            image = np.where(self._subjects[camera.name][..., None], image, image + wall)
            if step.kind == "olat":
                self._save(self.folder / "plate" / camera.name / str(step.light), wall + 0 * image)
        name = {
            "olat": str(step.light),
            "scanline": f"{step.projector}_{step.index}_{step.row}",
        }.get(step.kind, f"{step.kind}_{step.index}")
        self._save(self.folder / step.kind / camera.name / name, image)

    def _wall(self, image: Floats, camera: str) -> Floats:
        subject = self._subjects[camera]
        bright = np.quantile(image[subject], 0.95, axis=0) if subject.any() else np.zeros(3)
        return np.asarray(self.written.wall * np.maximum(bright, 0), np.float32)

    def _save(self, path: Path, radiance: Floats) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        kind = self.written.kind
        light = radiance / np.float32(self.full)
        if kind == "exr":
            full = EXPOSURE * self.full if self.written.blown else np.inf
            values = np.minimum(np.float32(EXPOSURE) * radiance, np.float32(full))
            scale = {"fullScale": full} if self.written.blown else {}
            write_exr(path.with_suffix(".exr"), values.astype(np.float32), scale, compress=False)
        elif kind == "png16":
            _save(path.with_suffix(".png"), np.clip(light, 0, 1) * 65535, np.uint16)
        elif kind == "png8":
            for k, share in enumerate(BRACKET):
                shot = _srgb(np.clip(light * np.float32(share / BRACKET[0]), 0, 1))
                _save(path.with_name(f"{path.name}_e{k}.png"), shot * 255, np.uint8)
        else:
            y, x = np.indices(light.shape[:2]) % 2
            mosaic = np.take_along_axis(light, COLOURS[y, x][..., None], axis=-1)[..., 0]
            counts = np.clip(BLACK + (WHITE - BLACK) * mosaic, 0, WHITE)
            _save(path.with_suffix(".tif"), counts, np.uint16)

    @cached_property
    def _subjects(self) -> dict[str, Bools]:
        return {c.name: silhouette(self.capture, c.name) for c in self.capture.rig.cameras}

    @cached_property
    def full(self) -> float:
        """The radiance at which a channel is full, in the shortest exposure of 8 bits."""
        brights = []
        for step in self.capture.steps:
            for camera in self.capture.rig.cameras:
                if step.kind != "dark" and self.capture.has(step, camera.name):
                    image = self.capture.frame(step, camera.name)
                    hair = image[self._subjects[camera.name]].max(axis=-1)
                    blown = self.written.blown and step.kind == "olat"
                    if blown:
                        brights.append(hair[hair > 0])
                    elif not self.written.blown:
                        brights.append(hair.max(initial=0.0, keepdims=True))
        found = np.concatenate(brights)
        return float(np.quantile(found, BLOWN) if self.written.blown else 1.02 * found.max())

    def _settings(self) -> str:
        kind = self.written.kind
        suffix = {"exr": ".exr", "bayer": ".tif"}.get(kind, ".png")
        exposure = "_{exposure}" if kind == "png8" else ""
        lines = [
            *(["exposures = { e0 = 0.0003125, e1 = 0.0025, e2 = 0.02 }"] if kind == "png8" else []),
            *([f"exposure = {EXPOSURE}"] if kind != "png8" else []),
            "[pictures]",
            *(
                f'{role} = "{role}/{{camera}}/{name}{exposure}{suffix}"'
                for role, name in (
                    ("olat", "{light}"),
                    ("dark", "dark_{number}"),
                    ("all_on", "all_on_{number}"),
                    ("tracking", "tracking_{number}"),
                    ("scanline", "{projector}_{number}_{row}"),
                )
            ),
        ]
        if self.written.wall:
            lines.append(f'clean_plate = "plate/{{camera}}/{{light}}{exposure}{suffix}"')
        if kind == "bayer":
            lines += ["[sensor]", 'bayer = "RGGB"', f"black = {BLACK}", f"white = {WHITE}"]
        lines += ["[geometry.placement]", 'unit = "mm"']
        return "\n".join(lines) + "\n"


def _save(path: Path, values: Array, kind: type) -> None:
    counts: NDArray[Any] = np.round(values).astype(kind)
    assert cv2.imwrite(str(path), counts[..., ::-1] if counts.ndim == 3 else counts)


def _srgb(light: Array) -> Array:
    power = 1.055 * np.maximum(light, 1e-12) ** (1 / 2.4) - 0.055
    return np.where(light <= 0.0031308, 12.92 * light, power)
