"""Capture folders: what the stage shot, and with which commands.

capture/
  rig.json        calibrated geometry (`Rig.to_dict`)
  plan.json       {"steps": [Step, ...], ...}: the commanded sequence
  journal.jsonl   append-only, fsynced: one line per frame, shot or missing; whoever writes or
                  compresses the capture holds its lock
  frames/00012/cam_00.exr    (cam_00.zip.exr once compressed)
  masks/cam_00.png    hair masks from the user, optional
  subjects/cam_00.png masks of hair, head and body, optional
  head.obj            the digitised head, optional
  manifest.json   written last: state, outcome, counts, checksums of the small files and of the
                  journal, whose lines hold the frames' checksums
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args

import numpy as np

from reconstruction.arrays import Bools, Floats
from reconstruction.capture.stray_light import stray_light
from reconstruction.containment import NotContained, inside, plain_file
from reconstruction.files.exr import read_exr
from reconstruction.files.masks import read_mask
from reconstruction.geometry.blocks import block_any, block_means, unblocked
from reconstruction.geometry.lens import Lens
from reconstruction.geometry.mesh import Mesh, read_obj
from reconstruction.geometry.rig import Rig, counted
from reconstruction.reading import parse_json, read_json

if TYPE_CHECKING:
    from reconstruction.capture.kept_frames import KeptFrames

T = TypeVar("T")
StepKind = Literal["dark", "all_on", "olat", "scanline", "tracking"]


class CaptureError(ValueError):
    """A capture folder that cannot be used as asked; the message names file and field."""


class MissingFrame(CaptureError):
    """A frame that was planned but never arrived."""


@dataclass(frozen=True)
class Step:
    """One commanded exposure of every camera.

    `level` scales the lights (`olat`, `all_on`) or the projector (`scanline`, `tracking`: all
    projectors on), 0 to 1; `exposure` is in seconds.
    """

    index: int
    kind: StepKind
    exposure: float
    level: float = 1.0
    light: str | None = None
    projector: str | None = None
    row: int | None = None

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Step:
        """Read one entry of `plan.json`; raises `CaptureError` naming the field that is wrong."""
        if not isinstance(data, dict):
            raise CaptureError(f"plan.json: a step is an object, got {data!r}")
        unknown = set(data) - {f.name for f in fields(cls)}
        if unknown:
            raise CaptureError(f"plan.json: step has unknown fields {sorted(unknown)}: {data}")
        try:
            step = cls(**data)
        except TypeError as error:
            raise CaptureError(f"plan.json: step {data}: {error}") from error
        if step.kind not in get_args(StepKind):
            raise CaptureError(f"plan.json: step {step.index}: unknown kind {step.kind!r}")
        numbers: tuple[tuple[str, type], ...] = (
            *(("index", int), ("row", int)),
            *(("exposure", float), ("level", float)),
        )
        for field, kind in numbers:
            value = getattr(step, field)
            fits = isinstance(value, kind | int) and not isinstance(value, bool)
            if not (fits or (field == "row" and value is None)):
                raise CaptureError(f"plan.json: step {data}: {field}: a number, got {value!r}")
        return step

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready description without the fields that are None."""
        return {k: v for k, v in asdict(self).items() if v is not None}


@dataclass(frozen=True)
class FrameRecord:
    """One line of the journal: a frame that was written, or a frame that never came.

    `file` is relative to the capture folder, None for a missing frame; `pulse` is the trigger
    box's count, `block_id` and `timestamp` the camera's; `reason` says why a frame is missing.
    """

    step: int
    camera: str
    file: str | None
    sha256: str | None = None
    pulse: int | None = None
    block_id: int | None = None
    timestamp: float | None = None
    attempt: int = 0
    recorded: str = ""
    reason: str | None = None


class Capture:
    """A capture folder, read; `view` sees a part of it. The module's docstring has the layout."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not (self.path / "rig.json").is_file() or not (self.path / "plan.json").is_file():
            raise CaptureError(
                f"{self.path} is not a capture: expected rig.json and plan.json; of a folder of "
                "photographs 'hairstage import' makes one"
            )
        try:
            self.rig = Rig.load(self._own("rig.json"))
            self.plan: dict[str, Any] = _object(self._own("plan.json"))
            self.steps = tuple(Step.from_dict(s) for s in _steps(self.plan))
            self.records = dict(self._journal())
        except (OSError, ValueError) as error:
            if isinstance(error, CaptureError):
                raise
            raise CaptureError(str(error)) from error
        self._shot = {c.name: c for c in self.rig.cameras}
        self._lenses: dict[str, Lens] = {}
        self._by = 1
        self._kept: KeptFrames | None = None
        self._stray: tuple[str, dict[tuple[int, ...], Floats | None]] = "", {}

    def view(
        self,
        *,
        cameras: Iterable[str] | None = None,
        lights: Iterable[str] | None = None,
        undistorted: bool | None = None,
        reduced: int | None = None,
    ) -> Capture:
        """The capture as if it had only these `cameras` and `lights`, and with pinholes if asked.

        Both in the rig's order; None keeps those that this view has. `lights` are those that are
        shot one at a time; the rig keeps its lights. `undistorted` resamples frames and masks of
        lenses that bend lines as they are read; False takes them as shot. `reduced` by n, pixels
        are the means over n × n of those on disk; 1 takes them as shot. The view reads the same
        folder; this one stays as it is. Raises `CaptureError` for names that are not there, and
        where pictures are too small to be reduced so.
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
            names = self._known("light", lights, self.olat_lights())
            out.steps = tuple(s for s in self.steps if s.kind != "olat" or s.light in names)
        return out

    def without_lights(self, names: Iterable[str]) -> Capture:
        """The capture as if these lights had not been shot one at a time.

        Raises `CaptureError` for names that are not there.
        """
        known = self.olat_lights()
        out = self._known("light", names, known)
        return self.view(lights=[name for name in known if name not in out])

    @property
    def lenses(self) -> Mapping[str, Lens]:
        """What an undistorted view resamples, by camera."""
        return self._lenses

    def _known(self, kind: str, names: Iterable[str], known: list[str]) -> set[str]:
        wanted = set(names)
        if unknown := sorted(wanted - set(known)):
            raise CaptureError(
                f"{self.path}: there is no {kind} {', '.join(unknown)}; {counted(known)}"
            )
        return wanted

    def mask_as_shot(self, camera: str, mask: Bools) -> Bools:
        """A mask `(H, W)` in the pixels of this view, in those of the frames on disk."""
        lens = self._lenses.get(camera)
        mask = mask if lens is None else lens.distort_mask(mask)
        shot = self._shot[camera]
        return mask if self._by == 1 else unblocked(mask, self._by, shot.height, shot.width)

    def strangers(self) -> list[Path]:
        """The files among the frames that no line of the journal names, as crashes leave them."""
        known = {self.path / r.file for r in self.records.values() if r.file is not None}
        return sorted(p for p in self.path.glob("frames/**/*") if p.is_file() and p not in known)

    def read_mask(self, path: Path, camera: str) -> Bools:
        """A mask `(H, W)` from a picture as large as the frames on disk, in this view's pixels.

        Half grey and above, and at least half of what a pixel stands for. Raises `CaptureError`.
        """
        shot, lens = self._shot[camera], self._lenses.get(camera)
        try:
            whole = read_mask(path, shot.width, shot.height)
        except (OSError, ValueError) as error:
            raise CaptureError(str(error)) from error
        mask = np.asarray(block_means(whole, self._by) >= 0.5)
        return mask if lens is None else lens.undistort_mask(mask)

    def _journal(self) -> Iterator[tuple[tuple[int, str], FrameRecord]]:
        """Records by (step, camera); later lines win. A torn last line is what a crash leaves."""
        path = self._own("journal.jsonl")
        lines = plain_file(path).read_bytes().splitlines() if path.exists() else []
        for number, line in enumerate(lines, 1):
            try:
                record = FrameRecord(**parse_json(line))
                if not isinstance(record.file, str | None):
                    raise TypeError(f"file: a name, got {record.file!r}")
                yield (int(record.step), str(record.camera)), record
            except (ValueError, TypeError) as error:
                if number == len(lines):
                    return
                raise CaptureError(f"{path}, line {number}: {error}") from error

    @cached_property
    def manifest(self) -> dict[str, Any] | None:
        """The manifest, or None while the capture is not finished. Raises `CaptureError`."""
        path = self._own("manifest.json")
        return _object(path) if path.exists() else None

    def has(self, step: Step, camera: str) -> bool:
        """Whether the frame was written."""
        record = self.records.get((step.index, camera))
        return record is not None and record.file is not None

    @property
    def reduced_by(self) -> int:
        """Pixels on disk that one of this view stands for, along a side."""
        return self._by

    def keeping(self, kept: KeptFrames) -> Capture:
        """This view, of which frames under single lights, once read, are in `kept`."""
        out = copy.copy(self)
        out._kept = kept
        return out

    def frame(self, step: Step, camera: str) -> Floats:
        """Scene-linear radiance `(H, W, 3)`, W/(sr m²), as exposed: at the step's light level.

        Noise may push dark pixels below zero. Raises `MissingFrame`.
        """
        lens = self._lenses.get(camera)
        if self._kept is not None and step.kind == "olat" and step.level in (0, 1):
            image = self._means(step, camera)[0]
        else:
            image = block_means(self._read(step, camera)[0], self._by)
        return image if lens is None else lens.undistort(image)

    def response(self, step: Step, camera: str) -> Floats:
        """`frame (H, W, 3)` over the step's level: the answer to the light at full intensity."""
        image = self.frame(step, camera)
        return image if step.level in (0, 1) else image / np.float32(step.level)

    def saturated(self, step: Step, camera: str) -> Bools:
        """Pixels `(H, W)` with a channel at the sensor's full scale."""
        return self.response_and_saturated(step, camera)[1]

    def response_and_saturated(self, step: Step, camera: str) -> tuple[Floats, Bools]:
        """`response (H, W, 3)` and `saturated (H, W)` of one frame, read once."""
        lens = self._lenses.get(camera)
        image, saturated = self._means(step, camera)
        if lens is None:
            return image, saturated
        return lens.undistort(image), lens.undistort_any(saturated)

    def _means(self, step: Step, camera: str) -> tuple[Floats, Bools]:
        """`response_and_saturated` through the lens."""
        if self._kept is not None and step.kind == "olat":
            return self._kept.get(step.index, camera, lambda: self._made(step, camera))
        return self._made(step, camera)

    def _made(self, step: Step, camera: str) -> tuple[Floats, Bools]:
        image, attributes = self._read(step, camera)
        full = np.float32(float(attributes.get("fullScale", np.inf)) * (1 - 1e-5))
        # an eighth of the time that any(axis=-1) takes, half of all that a frame costs
        red, green, blue = (image[..., channel] >= full for channel in range(3))
        saturated = red | green | blue
        image = image if step.level in (0, 1) else image / np.float32(step.level)
        if self._by == 1:
            return image, saturated
        return block_means(image, self._by), block_any(saturated, self._by)

    def count_scale(self, step: Step, camera: str) -> float:
        """Radiance of one count of the sensor in this frame; 0 where it was not quantised."""
        return float(self._read(step, camera)[1].get("countScale", 0.0))

    def has_light(self, light: str, camera: str) -> bool:
        """Whether a frame of this light alone was written, at any exposure."""
        return any(self.has(s, camera) for s in self._of_light.get(light, ()))

    def light(self, light: str, camera: str) -> tuple[Floats, Bools]:
        """Response `(H, W, 3)` to one light alone, and where `(H, W)` it is saturated.

        Light that the dark frames of the nearest exposure hold is taken off (`stray_light`). Where
        the light was shot with several exposures, their mean with the weight of exposure (the
        photons counted), without saturated pixels; saturated is what even the shortest exposure
        saturates. Raises `MissingFrame` where none of them came.
        """
        steps = self._of_light.get(light)
        if steps is None:
            raise MissingFrame(f"{self.path}: the plan has no frame for the light {light!r}")
        steps = [s for s in steps if self.has(s, camera)] or steps[:1]
        if len(steps) == 1:
            return self._answer(steps[0], camera)
        total = np.zeros((*self._shape(camera), 3), np.float32)
        weight = np.zeros(self._shape(camera), np.float32)
        by_exposure = sorted(steps, key=lambda s: s.exposure)
        shortest, clipped = self._answer(by_exposure[0], camera)
        for step in by_exposure:
            image, saturated = self._answer(step, camera)
            used = np.float32(step.exposure) * ~saturated
            total += used[..., None] * image
            weight += used
        merged = total / np.maximum(weight, np.finfo(np.float32).tiny)[..., None]
        return np.where(weight[..., None] > 0, merged, shortest), clipped

    def _answer(self, step: Step, camera: str) -> tuple[Floats, Bools]:
        """`response_and_saturated` without the light of dark frames."""
        image, saturated = self.response_and_saturated(step, camera)
        stray = self._stray_light(camera, step.exposure)
        if stray is not None:
            image = image - stray / np.float32(step.level or 1.0)
        return image, saturated

    def _stray_light(self, camera: str, exposure: float) -> Floats | None:
        """Kept of one camera, at all its exposures: frames are read camera by camera."""
        steps = self.dark_steps(camera, exposure)
        if self._stray[0] != camera:
            self._stray = camera, {}
        key, kept = tuple(s.index for s in steps), self._stray[1]
        if key not in kept:
            dark = [self.frame(s, camera) for s in steps]
            kept[key] = stray_light(np.mean(dark, axis=0)) if dark else None
        return kept[key]

    def dark_steps(self, camera: str, exposure: float | None = None) -> list[Step]:
        """The dark frames that `camera` wrote; with `exposure` those at the nearest one."""
        steps = [s for s in self.of_kind("dark") if self.has(s, camera)]
        if exposure is None or not steps:
            return steps
        nearest = min((s.exposure for s in steps), key=lambda e: abs(e - exposure))
        return [s for s in steps if s.exposure == nearest]

    @cached_property
    def _of_light(self) -> dict[str, list[Step]]:
        out: dict[str, list[Step]] = {}
        for step in self.of_kind("olat"):
            assert step.light is not None
            out.setdefault(step.light, []).append(step)
        return out

    def read_file(self, step: Step, camera: str, read: Callable[[Path], T]) -> T:
        """What `read` makes of a frame's file; raises what it raises, and `MissingFrame`.

        Compression may put another file in its place at any moment: where it has gone, the
        journal is read anew.
        """
        file = self._file(step, camera)
        while True:
            try:
                return read(file)
            except (OSError, ValueError):
                if file.exists():
                    raise
                self.records = dict(self._journal())
                gone, file = file, self._file(step, camera)
                if file == gone:
                    raise

    def _file(self, step: Step, camera: str) -> Path:
        record = self.records.get((step.index, camera))
        if record is None or record.file is None:
            why = record.reason if record is not None else "it was never shot"
            raise MissingFrame(f"{self.path}: step {step.index} ({step.kind}), {camera}: {why}")
        return self.file_of(record)

    def file_of(self, record: FrameRecord) -> Path:
        """Where a frame that was written lies. Raises `CaptureError` where that is elsewhere."""
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
        """Steps of one kind in the order they were shot."""
        return tuple(s for s in self.steps if s.kind == kind)

    def olat(self, camera: str, lights: list[str] | None = None) -> tuple[Floats, Bools]:
        """Responses `(L, H, W, 3)` to single lights, in the order of `lights` (default: rig order).

        Also where they are known `(L, H, W)`: not where saturated, nor, with zeros, where the frame
        is missing. Raises `MissingFrame` where the plan never had one of the lights.
        """
        names = self.olat_lights() if lights is None else lights
        absent = [n for n in names if n not in self._of_light]
        if absent:
            raise MissingFrame(f"{self.path}: the plan has no frame for the lights {absent[:5]}")
        out = np.zeros((len(names), *self._shape(camera), 3), np.float32)
        known = np.zeros(out.shape[:3], bool)
        for i, name in enumerate(names):
            if self.has_light(name, camera):
                out[i], saturated = self.light(name, camera)
                known[i] = ~saturated
        return out, known

    def olat_lights(self) -> list[str]:
        """Names of the lights that were shot one at a time, in rig order."""
        return [light.name for light in self.rig.lights if light.name in self._of_light]

    def mask(self, camera: str) -> Bools | None:
        """The user's hair mask `(H, W)` (half grey and above), or None when there is none."""
        return self._given("masks", camera)

    def subject(self, camera: str) -> Bools | None:
        """Where `(H, W)` hair, head and body are, or None where nobody has said it."""
        return self._given("subjects", camera)

    def _given(self, folder: str, camera: str) -> Bools | None:
        path = self._own(f"{folder}/{camera}.png")
        if not path.is_file():
            return None
        return self.read_mask(path, camera)

    @cached_property
    def head(self) -> Mesh | None:
        """The digitised head, or None when the capture has none."""
        path = self._own("head.obj")
        return read_obj(path) if path.is_file() else None

    def _shape(self, camera: str) -> tuple[int, int]:
        c = self.rig.camera(camera)
        return c.height, c.width


def _object(path: Path) -> dict[str, Any]:
    """The object that a JSON file of a capture holds."""
    try:
        data = read_json(path)
    except (OSError, ValueError) as error:
        raise CaptureError(str(error)) from error
    if not isinstance(data, dict):
        raise CaptureError(f"{path}: expected an object, got {type(data).__name__}")
    return data


def _steps(plan: dict[str, Any]) -> list[Any]:
    steps = plan.get("steps")
    if not isinstance(steps, list):
        raise CaptureError(f"plan.json: the field 'steps' must be a list, got {steps!r}")
    return steps
