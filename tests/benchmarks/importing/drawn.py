"""Captures of any size whose frames are painted as they are read: nothing of them lies on disk."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cache, cached_property
from pathlib import Path

import cv2
import numpy as np

from reconstruction import Camera, Capture, Mesh, Projector, Rig, Step, Strands, write_obj
from reconstruction.arrays import Array, Floats, Ints
from reconstruction.capture.records import FrameRecord
from reconstruction.files.durable import write_json
from reconstruction.geometry.mesh_queries import mesh_depth
from simulators.subject.subject import make_subject

NOISE = 0.002  # of a fully lit pixel
HAIR, SKIN = (0.35, 0.2, 0.1), (0.45, 0.31, 0.25)
AMBIENT = 0.3  # of a pixel's light that no surface takes away
LOBE = 0.2  # width of the highlight, in sines
BLOCK = 1 << 14  # pixels that are painted together: they stay in the cache
SHIFTS = 64  # pixels by which the noise differs from frame to frame


class DrawnCapture(Capture):
    """A capture of the groom "wavy" of which the folder holds no frame; see `write`.

    Hair answers as Kajiya and Kay (1989) say, skin as a matte ball would; nothing casts a shadow.
    """

    @classmethod
    def write(cls, folder: Path, rig: Rig, *, sweep: bool, all_on: bool, seed: int = 0) -> Capture:
        """Write the capture's plan for `rig`, with single lights, a `sweep`, an `all_on` frame."""
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / "rig.json", rig.to_dict())
        steps = [Step(0, "dark", 0.01)] + [Step(1, "all_on", 0.01)] * all_on
        for light in rig.lights:
            steps.append(Step(len(steps), "olat", 0.01, light=light.name))
        for projector in rig.projectors if sweep else ():
            for row in range(projector.height):
                steps.append(Step(len(steps), "scanline", 0.01, projector=projector.name, row=row))
        write_json(folder / "plan.json", {"steps": [s.to_dict() for s in steps], "seed": seed})
        head = make_subject("wavy", seed).head
        assert head is not None
        write_obj(folder / "head.obj", head)
        strands = make_subject("wavy", seed).strands
        for camera in rig.cameras:
            _View.of(camera, strands, head).save(folder / f"{camera.name}.npz")
        return cls(folder)

    def __init__(self, path: str | Path) -> None:
        super().__init__(path)
        self.records = {
            (s.index, c.name): FrameRecord(s.index, c.name, "painted")
            for s in self.steps
            for c in self.rig.cameras
        }
        self._views: dict[str, _View] = {}

    def _read(self, step: Step, camera: str) -> tuple[Floats, dict[str, float | str]]:
        if camera not in self._views:
            self._views.clear()  # the pipeline goes camera by camera
            self._views[camera] = _View.load(self.path / f"{camera}.npz")
        view = self._views[camera]
        x, y = np.random.default_rng(step.index).integers(0, SHIFTS, 2)
        height, width = view.shape
        out = _noise(height, width)[y : y + height, x : x + width].copy()
        flat = out.reshape(-1, 3)
        if step.kind == "scanline" and step.projector is not None and step.row is not None:
            projector = self.rig.projector(step.projector)
            order, rows = view.rows(projector)
            first, last = np.searchsorted(rows, (step.row - 3, step.row + 3))
            lit = order[first:last]
            share = projector.row_weight(step.row, rows[first:last]).astype(np.float32)
            flat[view.at[lit]] += share[:, None] * view.reflectance(projector.center, lit)
        elif step.kind == "olat" and step.light is not None:
            position = self.rig.light(step.light).position
            for begin in range(0, len(view.at), BLOCK):
                part = slice(begin, begin + BLOCK)
                flat[view.at[part]] += view.reflectance(position, part)
        elif step.kind == "all_on":
            flat[view.at] += view.colour
        return out, {}


@dataclass(frozen=True, eq=False)
class _View:
    """What one camera sees: pixels `at (P,)`, their points, normals and tangents `(P, 3)`.

    Where there is skin the tangent is 0. `colour (P, 3)`; `away (P,)` is the tangent's sine to the
    camera.
    """

    shape: tuple[int, int]
    at: Ints
    points: Floats
    normals: Floats
    tangents: Floats
    colour: Floats
    away: Floats

    @classmethod
    def of(cls, camera: Camera, strands: Strands, head: Mesh) -> _View:
        """Strands drawn from the furthest to the nearest, and the head between them."""
        pixels, depth = camera.project(strands.points)
        inner = np.ones(len(strands.points), bool)
        inner[strands.offsets[1:] - 1] = False
        first = np.flatnonzero(inner)
        first = first[np.argsort(-depth[first])]
        numbers = np.zeros((camera.height, camera.width), np.float32)  # a segment's, from 1
        fixed = np.rint(pixels * 16).astype(int)
        wide = 2 * float(np.mean(strands.radius)) * camera.K[0, 0] / float(np.median(depth))
        for i in first:
            ends = tuple(fixed[i]), tuple(fixed[i + 1])
            cv2.line(numbers, *ends, float(i + 1), max(1, round(wide)), cv2.LINE_8, 4)
        segment = numbers.astype(np.int64) - 1
        skin_depth = mesh_depth(camera, head)
        hair = (segment >= 0) & (depth[segment] < skin_depth + 1e-3)
        skin = np.isfinite(skin_depth) & ~hair
        y, x = np.nonzero(hair | skin)
        segment, is_hair = segment[y, x], hair[y, x]
        rays = camera.rays(np.stack([x, y], axis=1))
        far = np.where(is_hair, depth[segment], skin_depth[y, x])
        points = camera.center + rays * (far / (rays @ camera.R[2]))[:, None]
        after = np.minimum(segment + 1, len(strands.points) - 1)
        tangents = np.where(is_hair[:, None], strands.points[after] - strands.points[segment], 0.0)
        length = np.linalg.norm(tangents, axis=1, keepdims=True)
        tangents = tangents / np.where(length > 0, length, 1.0)
        normals = points / np.linalg.norm(points, axis=1, keepdims=True)
        shade = np.random.default_rng(0).uniform(0.6, 1.4, len(strands.points))[segment, None]
        colour = np.where(is_hair[:, None], HAIR * shade, SKIN)
        away = -(tangents * rays).sum(axis=1)
        found = [a.astype(np.float32) for a in (points, normals, tangents, colour, away)]
        return cls((camera.height, camera.width), y * camera.width + x, *found)

    def save(self, file: Path) -> None:
        """Keep it: what a camera sees takes far longer to work out than a frame."""
        np.savez(file, **{f.name: getattr(self, f.name) for f in fields(self)})

    @classmethod
    def load(cls, file: Path) -> _View:
        """What was kept."""
        with np.load(file) as data:
            found = {f.name: data[f.name] for f in fields(cls)}
        return cls(**(found | {"shape": tuple(found["shape"].tolist())}))

    def reflectance(self, position: Array, some: Ints | slice) -> Floats:
        """What `some` of the pixels answer to a light at `position (3,)`: `(Q, 3)`."""
        to = position.astype(np.float32) - self.points[some]
        to /= np.sqrt(np.einsum("pi,pi->p", to, to))[:, None]
        facing = AMBIENT + np.maximum(np.einsum("pi,pi->p", to, self.normals[some]), 0)
        along = np.einsum("pi,pi->p", to, self.tangents[some])
        matte = facing * np.sqrt(np.maximum(1 - along * along, 0))
        gloss = facing * np.exp(-(((along + self.away[some]) / LOBE) ** 2))
        gloss[~self.tangents[some].any(axis=1)] = 0
        return np.asarray(matte[:, None] * self.colour[some] + 0.2 * gloss[:, None])

    @cached_property
    def _rows(self) -> dict[str, tuple[Ints, Array]]:
        return {}

    def rows(self, projector: Projector) -> tuple[Ints, Array]:
        """The pixels' numbers `(P,)` in the order of their rows in `projector`, and these."""
        if projector.name not in self._rows:
            row = projector.project(self.points)[0][:, 1]
            order = np.argsort(row)
            self._rows[projector.name] = order, row[order]
        return self._rows[projector.name]


@cache
def _noise(height: int, width: int) -> Floats:
    rng = np.random.default_rng(0)
    shape = height + SHIFTS, width + SHIFTS, 3
    return NOISE * rng.standard_normal(shape, dtype=np.float32)
