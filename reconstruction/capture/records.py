"""Steps of a plan and lines of a journal, as a capture folder stores them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

from reconstruction.containment import plain_file
from reconstruction.reading import parse_json, read_json

StepKind = Literal["dark", "all_on", "olat", "pattern", "scanline", "tracking"]


class CaptureError(ValueError):
    """A capture folder that cannot be used; the message names the file and the field."""


class MissingFrame(CaptureError):
    """A planned frame that is missing from the capture."""


@dataclass(frozen=True)
class Step:
    """One commanded exposure of all cameras.

    `level`, 0 to 1, scales the lights (`olat`, `all_on`, `pattern`) or projectors (`scanline`,
    `tracking`: all projectors on); `exposure` is in seconds.
    """

    index: int
    kind: StepKind
    exposure: float
    level: float = 1.0
    light: str | None = None
    projector: str | None = None
    row: int | None = None
    pattern: str | None = None

    @property
    def lighting(self) -> str | None:
        """The single light or the pattern of a frame."""
        return self.light if self.kind == "olat" else self.pattern

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
    """One line of the journal: a written or a missing frame.

    `file` is relative to the capture folder, None for a missing frame; `pulse` is the trigger
    box's count, `block_id` and `timestamp` are the camera's; `reason` is why a frame is missing.
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


def read_steps(plan: dict[str, Any]) -> tuple[Step, ...]:
    """The steps of `plan.json`. Raises `CaptureError`."""
    steps = plan.get("steps")
    if not isinstance(steps, list):
        raise CaptureError(f"plan.json: the field 'steps' must be a list, got {steps!r}")
    return tuple(Step.from_dict(s) for s in steps)


def origin(plan: dict[str, Any]) -> str | None:
    """When a plan was shot, or the folder it was imported from; None where neither is recorded."""
    found = plan.get("started", plan.get("imported_from"))
    return None if found is None else str(found)


def read_journal(path: Path) -> dict[tuple[int, str], FrameRecord]:
    """Records by (step, camera); later lines replace earlier ones. Raises `CaptureError`.

    A torn last line is ignored: a crash leaves one.
    """
    out = {}
    lines = plain_file(path).read_bytes().splitlines() if path.exists() else []
    for number, line in enumerate(lines, 1):
        try:
            record = FrameRecord(**parse_json(line))
            if not isinstance(record.file, str | None):
                raise TypeError(f"file: a name, got {record.file!r}")
            out[int(record.step), str(record.camera)] = record
        except (ValueError, TypeError) as error:
            if number < len(lines):
                raise CaptureError(f"{path}, line {number}: {error}") from error
    return out


def read_object(path: Path) -> dict[str, Any]:
    """The object in a JSON file of a capture. Raises `CaptureError`."""
    try:
        data = read_json(path)
    except (OSError, ValueError) as error:
        raise CaptureError(str(error)) from error
    if not isinstance(data, dict):
        raise CaptureError(f"{path}: expected an object, got {type(data).__name__}")
    return data
