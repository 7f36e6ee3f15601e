"""Capture folders: the frames of a stage and the commands that made them.

capture/
  rig.json        calibrated geometry (`Rig.to_dict`)
  plan.json       {"steps": [Step, ...], "patterns": `LightPatterns.to_dict`, ...}: the sequence
  journal.jsonl   append-only, fsynced: one line per frame, written or missing; locked by the
                  process that writes or compresses the capture
  frames/00012/cam_00.exr    (cam_00.zip.exr once compressed)
  masks/cam_00.png    hair masks of the user, optional
  subjects/cam_00.png masks of hair, head and body, optional
  head.obj            the digitised head, optional
  manifest.json   written last: state, outcome, counts, checksums of the small files and of the
                  journal, which holds the frames' checksums
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from reconstruction.arrays import Bools, Floats
from reconstruction.capture.exposures import averaged
from reconstruction.capture.light_patterns import LightPatterns, PatternError
from reconstruction.capture.records import (
    CaptureError,
    FrameRecord,
    MissingFrame,
    Step,
    StepKind,
    read_journal,
    read_object,
    read_steps,
)
from reconstruction.capture.stray_light import stray_light
from reconstruction.containment import NotContained, inside, plain_file
from reconstruction.files.exr import read_exr
from reconstruction.files.masks import read_mask
from reconstruction.geometry.blocks import block_any, block_means, unblocked
from reconstruction.geometry.lens import Lens
from reconstruction.geometry.lights import Lighting
from reconstruction.geometry.mesh import Mesh, read_obj
from reconstruction.geometry.rig import Rig, counted
from reconstruction.geometry.world_frame import WorldFrame

T = TypeVar("T")
Pixels = tuple[Floats, Bools]
"""Radiance `(H, W, 3)` at full light level, and saturated pixels `(H, W)`."""
Cache = Callable[[int, str, Callable[[], Pixels]], Pixels]
"""Pixels by step and camera; the last argument computes them the first time."""


class Capture:
    """A capture folder, read; `view` restricts it. The module's docstring has the layout."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not (self.path / "rig.json").is_file() or not (self.path / "plan.json").is_file():
            raise CaptureError(
                f"{self.path} is not a capture: expected rig.json and plan.json; convert a folder "
                "of photographs with 'hairstage import'"
            )
        try:
            self.rig = Rig.load(self._own("rig.json"))
            self.plan: dict[str, Any] = read_object(self._own("plan.json"))
            self.steps = read_steps(self.plan)
            self.records = read_journal(self._own("journal.jsonl"))
        except (OSError, ValueError) as error:
            if isinstance(error, CaptureError):
                raise
            raise CaptureError(str(error)) from error
        self._shot = {c.name: c for c in self.rig.cameras}
        self._lenses: dict[str, Lens] = {}
        self._by = 1
        self._cache: Cache | None = None
        self._stray: tuple[str, dict[tuple[int, ...], Floats | None]] = "", {}

    def view(
        self,
        *,
        cameras: Iterable[str] | None = None,
        lights: Iterable[str] | None = None,
        undistorted: bool | None = None,
        reduced: int | None = None,
    ) -> Capture:
        """An immutable view of the same folder, restricted to these `cameras` and `lights`.

        None keeps those of this view. `lights` selects among `lightings`; the rig keeps all lights.
        `undistorted` resamples frames and masks to pinhole cameras as they are read; False
        keeps the lenses. `reduced` by n averages n × n pixels; 1 keeps all pixels. Raises
        `CaptureError` for unknown names and for images too small for `reduced`.
        """
        out = copy.copy(self)
        out.__dict__.pop("_of_light", None)
        out._stray = "", {}
        chosen = list(self.rig.cameras)
        if cameras is not None:
            names = self._known("camera", cameras, [c.name for c in chosen])
            chosen = [c for c in chosen if c.name in names]
        if undistorted is not None or reduced is not None:
            out._by = reduced or self._by
            try:
                chosen = [self._shot[c.name].reduced(out._by) for c in chosen]
            except ValueError as error:
                raise CaptureError(f"{self.path}: {error}") from error
            straight = bool(self._lenses) if undistorted is None else undistorted
            out._lenses = {c.name: Lens.of(c) for c in chosen if straight and c.distorted}
            chosen = [
                out._lenses[c.name].undistorted if c.name in out._lenses else c for c in chosen
            ]
        out.rig = replace(self.rig, cameras=tuple(chosen))
        if lights is not None:
            names = self._known("light", lights, self.lightings())
            kind = "olat" if self.olat_lights() else "pattern"
            out.steps = tuple(s for s in self.steps if s.kind != kind or s.lighting in names)
        return out

    def without_lights(self, names: Iterable[str]) -> Capture:
        """A view without the frames of these `lightings`. Raises `CaptureError`."""
        known = self.lightings()
        excluded = self._known("light", names, known)
        return self.view(lights=[name for name in known if name not in excluded])

    @property
    def lenses(self) -> Mapping[str, Lens]:
        """The lenses that an undistorted view removes, by camera."""
        return self._lenses

    def _known(self, kind: str, names: Iterable[str], known: list[str]) -> set[str]:
        wanted = set(names)
        if unknown := sorted(wanted - set(known)):
            raise CaptureError(f"{self.path}: no {kind} {', '.join(unknown)}; {counted(known)}")
        return wanted

    def mask_as_shot(self, camera: str, mask: Bools) -> Bools:
        """A mask `(H, W)` of this view resampled to the pixels of the frames on disk."""
        lens = self._lenses.get(camera)
        mask = mask if lens is None else lens.distort_mask(mask)
        shot = self._shot[camera]
        return mask if self._by == 1 else unblocked(mask, self._by, shot.height, shot.width)

    def read_mask(self, path: Path, camera: str) -> Bools:
        """A mask `(H, W)` in this view's pixels, from an image the size of the frames on disk.

        True where at least half of the averaged pixels are half grey. Raises `CaptureError`.
        """
        shot, lens = self._shot[camera], self._lenses.get(camera)
        try:
            whole = read_mask(path, shot.width, shot.height)
        except (OSError, ValueError) as error:
            raise CaptureError(str(error)) from error
        mask = np.asarray(block_means(whole, self._by) >= 0.5)
        return mask if lens is None else lens.undistort_mask(mask)

    @cached_property
    def manifest(self) -> dict[str, Any] | None:
        """The manifest, None before the capture is finished. Raises `CaptureError`."""
        path = self._own("manifest.json")
        return read_object(path) if path.exists() else None

    def has(self, step: Step, camera: str) -> bool:
        """Whether the frame was written."""
        record = self.records.get((step.index, camera))
        return record is not None and record.file is not None

    @property
    def reduced_by(self) -> int:
        """Pixels on disk per pixel of this view, along one side."""
        return self._by

    def with_cache(self, cache: Cache) -> Capture:
        """This view with its single-light frames read through `cache`."""
        out = copy.copy(self)
        out._cache = cache
        return out

    def frame(self, step: Step, camera: str) -> Floats:
        """Scene-linear radiance `(H, W, 3)`, W/(sr m²), at the step's light level.

        Dark pixels may be negative by noise. Raises `MissingFrame`.
        """
        lens = self._lenses.get(camera)
        if self._cache is not None and step.kind == "olat" and step.level in (0, 1):
            image = self._pixels(step, camera)[0]
        else:
            image = block_means(self._read(step, camera)[0], self._by)
        return image if lens is None else lens.undistort(image)

    def response(self, step: Step, camera: str) -> Floats:
        """`frame (H, W, 3)` divided by the step's level: radiance under the light at full level."""
        image = self.frame(step, camera)
        return image if step.level in (0, 1) else image / np.float32(step.level)

    def saturated(self, step: Step, camera: str) -> Bools:
        """Pixels `(H, W)` with a channel at the sensor's full scale."""
        return self.response_and_saturated(step, camera)[1]

    def response_and_saturated(self, step: Step, camera: str) -> Pixels:
        """`response (H, W, 3)` and `saturated (H, W)` of one frame, read once."""
        lens = self._lenses.get(camera)
        image, saturated = self._pixels(step, camera)
        if lens is None:
            return image, saturated
        return lens.undistort(image), lens.undistort_any(saturated)

    def _pixels(self, step: Step, camera: str) -> Pixels:
        """`response_and_saturated` before the lens is removed."""
        if self._cache is not None and step.kind == "olat":
            return self._cache(step.index, camera, lambda: self._read_pixels(step, camera))
        return self._read_pixels(step, camera)

    def _read_pixels(self, step: Step, camera: str) -> Pixels:
        image, attributes = self._read(step, camera)
        full = np.float32(float(attributes.get("fullScale", np.inf)) * (1 - 1e-5))
        saturated = np.zeros(image.shape[:2], bool)  # a tenth of the time of any(axis=-1)
        saturated.ravel()[np.flatnonzero(image >= full) // 3] = True
        image = image if step.level in (0, 1) else image / np.float32(step.level)
        if self._by == 1:
            return image, saturated
        return block_means(image, self._by), block_any(saturated, self._by)

    def has_light(self, light: str, camera: str) -> bool:
        """Whether a frame of this single light or pattern was written, at any exposure."""
        return any(self.has(s, camera) for s in self._of_light.get(light, ()))

    def light(self, light: str, camera: str) -> Pixels:
        """Radiance `(H, W, 3)` under one light or pattern at full level, and saturated `(H, W)`.

        The `stray_light` of the dark frames at the nearest exposure is subtracted, and several
        exposures are `averaged`. Raises `MissingFrame`.
        """
        steps = self._of_light.get(light)
        if steps is None:
            raise MissingFrame(f"{self.path}: the plan has no frame under {light!r} alone")
        steps = [s for s in steps if self.has(s, camera)] or steps[:1]
        if len(steps) == 1:
            return self._unlit_subtracted(steps[0], camera)
        steps = sorted(steps, key=lambda s: s.exposure)
        return averaged((s.exposure, *self._unlit_subtracted(s, camera)) for s in steps)

    def _unlit_subtracted(self, step: Step, camera: str) -> Pixels:
        """`response_and_saturated` minus the stray light of the dark frames."""
        image, saturated = self.response_and_saturated(step, camera)
        stray = self.stray_light_of(camera, step.exposure)
        if stray is not None:
            image = image - stray / np.float32(step.level or 1.0)
        return image, saturated

    def stray_light_of(self, camera: str, exposure: float) -> Floats | None:
        """Stray light `(H, W, 3)`, cached for one camera: frames are read camera by camera."""
        steps = self.dark_steps(camera, exposure)
        if self._stray[0] != camera:
            self._stray = camera, {}
        key, cached = tuple(s.index for s in steps), self._stray[1]
        if key not in cached:
            dark = [self.frame(s, camera) for s in steps]
            cached[key] = stray_light(np.mean(dark, axis=0)) if dark else None
        return cached[key]

    def dark_steps(self, camera: str, exposure: float | None = None) -> list[Step]:
        """The dark frames written by `camera`; with `exposure` those nearest to it."""
        steps = [s for s in self.of_kind("dark") if self.has(s, camera)]
        if exposure is None or not steps:
            return steps
        nearest = min((s.exposure for s in steps), key=lambda e: abs(e - exposure))
        return [s for s in steps if s.exposure == nearest]

    @cached_property
    def _of_light(self) -> dict[str, list[Step]]:
        out: dict[str, list[Step]] = {}
        for step in (s for s in self.steps if s.lighting is not None):
            out.setdefault(str(step.lighting), []).append(step)
        return out

    def read_file(self, step: Step, camera: str, read: Callable[[Path], T]) -> T:
        """`read` applied to a frame's file; raises as `read` does, and `MissingFrame`.

        If compression has replaced the file in the meantime, the journal is read again.
        """
        file = self._file(step, camera)
        while True:
            try:
                return read(file)
            except (OSError, ValueError):
                if file.exists():
                    raise
                self.records = read_journal(self._own("journal.jsonl"))
                gone, file = file, self._file(step, camera)
                if file == gone:
                    raise

    def _file(self, step: Step, camera: str) -> Path:
        record = self.records.get((step.index, camera))
        if record is None or record.file is None:
            why = record.reason if record is not None else "it was never captured"
            raise MissingFrame(f"{self.path}: step {step.index} ({step.kind}), {camera}: {why}")
        return self.file_of(record)

    def file_of(self, record: FrameRecord) -> Path:
        """The path of a written frame. Raises `CaptureError` if it is outside the folder."""
        return self._own(record.file or "")

    def _own(self, name: str) -> Path:
        """The path of one of this folder's files."""
        try:
            path = inside(self.path, name)
            return plain_file(path) if path.exists() else path
        except NotContained as error:
            raise CaptureError(f"{self.path}: {error}") from error

    def _read(self, step: Step, camera: str) -> tuple[Floats, dict[str, float | str]]:
        return self.read_file(step, camera, read_exr)

    def of_kind(self, kind: StepKind) -> tuple[Step, ...]:
        """Steps of one kind in capture order."""
        return tuple(s for s in self.steps if s.kind == kind)

    def olat(self, camera: str, lights: list[str] | None = None) -> tuple[Floats, Bools]:
        """Radiance `(L, H, W, 3)` under single lights, in the order of `lights` or of the rig.

        Also the valid pixels `(L, H, W)`: not saturated and not of a missing frame, which is 0.
        Raises `MissingFrame` if the plan has no frame of one of the lights.
        """
        names = self.olat_lights() if lights is None else lights
        absent = [n for n in names if n not in self._of_light]
        if absent:
            raise MissingFrame(f"{self.path}: the plan has no single-light frames of {absent[:5]}")
        out = np.zeros((len(names), *self._shape(camera), 3), np.float32)
        known = np.zeros(out.shape[:3], bool)
        for i, name in enumerate(names):
            if self.has_light(name, camera):
                out[i], saturated = self.light(name, camera)
                known[i] = ~saturated
        return out, known

    def olat_lights(self) -> list[str]:
        """Names of the lights with single-light frames, in rig order."""
        return [light.name for light in self.rig.lights if light.name in self._of_light]

    @cached_property
    def patterns(self) -> LightPatterns | None:
        """The patterns of lights of its frames, None without any. Raises `CaptureError`."""
        names = {str(s.pattern) for s in self.of_kind("pattern")}
        try:
            return LightPatterns.of_plan(self.plan, self.rig, names) if names else None
        except PatternError as error:
            raise CaptureError(f"{self.path / 'plan.json'}: patterns: {error}") from error

    def lightings(self) -> list[str]:
        """Names of the single lights with frames, in rig order; without any, of the patterns."""
        shot = [n for n in self.patterns.names if n in self._of_light] if self.patterns else []
        return self.olat_lights() or shot

    def lighting(self, name: str) -> Lighting:
        """A single light or a pattern, by its name."""
        shot = self.patterns
        own = shot is not None and name in shot.names
        return shot.pattern(name, self.rig) if shot and own else self.rig.light(name)

    def without_single_lights(self) -> tuple[Step, ...]:
        """Without single lights: the frames of texture, fully lit ones, else those of patterns."""
        return () if self.olat_lights() else self.of_kind("all_on") or self.of_kind("pattern")

    def mask(self, camera: str) -> Bools | None:
        """The user's hair mask `(H, W)`, None without one."""
        return self._user_mask("masks", camera)

    def subject(self, camera: str) -> Bools | None:
        """The user's mask `(H, W)` of hair, head and body, None without one."""
        return self._user_mask("subjects", camera)

    def _user_mask(self, folder: str, camera: str) -> Bools | None:
        path = self._own(f"{folder}/{camera}.png")
        if not path.is_file():
            return None
        return self.read_mask(path, camera)

    @cached_property
    def world(self) -> WorldFrame | None:
        """The frame of the user's cameras, None for a capture of the stage itself."""
        try:
            return WorldFrame.of_plan(self.plan)
        except (TypeError, ValueError) as error:
            raise CaptureError(f"{self.path / 'plan.json'}: {error}") from error

    @cached_property
    def head(self) -> Mesh | None:
        """The digitised head, None without one."""
        path = self._own("head.obj")
        return read_obj(path) if path.is_file() else None

    def _shape(self, camera: str) -> tuple[int, int]:
        c = self.rig.camera(camera)
        return c.height, c.width
