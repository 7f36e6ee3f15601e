"""Captures made elsewhere: a folder of cameras, lights and pictures becomes a `Capture`.

folder/
  cameras.json      {"cameras": [{"id", "width", "height", "K", "R", "t"}, ...]}
  lights.json       {"lights": [{"id", "position", "intensity", "colocated_camera"}, ...]}
  projectors.json   {"projectors": [...]} as in a capture's rig.json, where rows were swept
  import.toml       where the pictures lie and what their numbers mean (`ImportSettings`), optional
  images/<camera>/<light>.*      the picture under that light alone, where import.toml says nothing
  masks/<camera>.png             hair masks, optional
  subjects/<camera>.png          masks of hair, head and body, optional
  head.obj                       the head's mesh in the same frame, optional
  scalp.obj                      digitised points of the scalp in the same frame, optional

Conventions are those of `Camera` and `Light`: OpenCV, metres, pixel centres at integers, W/sr. An
`id` may be a string, which then is the name of folder or file, or a number n, which stands for
`cam_0n` and `light_0n` (two digits at least). `colocated_camera` holds a camera's id or null.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from reconstruction.arrays import Bools, Floats
from reconstruction.capture.exposures import Merged, Unchanged, flattened, merge
from reconstruction.capture.folder import Capture, Step
from reconstruction.capture.grey_ball import PlacedBall, Scale
from reconstruction.capture.import_geometry import Geometry
from reconstruction.capture.import_origin import Origin
from reconstruction.capture.import_settings import (
    SETTINGS,
    Bracket,
    Found,
    ImportProblem,
    ImportSettings,
    find,
    read_settings,
)
from reconstruction.capture.import_tables import (
    cameras_of,
    check_metres,
    head_of,
    lights_of,
    projectors_of,
    scalp_of,
)
from reconstruction.capture.likely_lights import LIKELY, likely_strength
from reconstruction.capture.writer import CaptureWriter
from reconstruction.files.durable import write_whole
from reconstruction.files.masks import AS_STORED, check_alpha, half_grey
from reconstruction.files.pictures import PictureError, picture_size, read_picture
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lens import Lens
from reconstruction.geometry.lens_models import LensModelCamera
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.placement import PlacementError, resized
from reconstruction.geometry.rig import Rig
from reconstruction.report.report import Progress, silent

FLAT_FULL = 0.01
"""Share of a flat field that may saturate: specks."""
LOOKS = 48
"""Frames that are read, drawn from all, for what a grey ball says, or how strong lights may be."""


def import_folder(
    folder: str | Path,
    out: str | Path,
    progress: Progress = silent,
    geometry: Geometry | None = None,
    settings: ImportSettings | None = None,
) -> Capture:
    """Turn `folder` (see the module's docstring) into the capture `out`, a new or empty folder.

    As `Import.of(folder, geometry, settings).write(out)`. Raises `ImportProblem`.
    """
    return Import.of(Path(folder), geometry, settings).write(Path(out), progress)


def settings_of(folder: Path, file: Path | None = None) -> ImportSettings:
    """Those of `file`, or of the folder's import.toml where it has one. Raises `ImportProblem`."""
    own = folder / SETTINGS
    if file is None and not own.is_file():
        return ImportSettings()
    return read_settings(file or own)


@dataclass(frozen=True, eq=False)
class Import:
    """A folder as it was understood: nothing but names and sizes has been read yet.

    `shot` are the cameras of the pictures, by name; `lenses` of those whose pictures are resampled,
    as a rig cannot hold their lens; `rig` is the capture's; `ball` is grey and tells W/(sr m²).
    All of them, `head` and `scalp` (the text of scalp.obj) are about `origin`.
    """

    folder: Path
    settings: ImportSettings
    rig: Rig
    shot: Mapping[str, Camera]
    lenses: Mapping[str, Lens]
    found: Found
    head: Mesh | None
    ball: PlacedBall | None = None
    scalp: str | None = None
    origin: Origin = field(default_factory=Origin)

    @classmethod
    def of(
        cls,
        folder: Path,
        geometry: Geometry | None = None,
        settings: ImportSettings | None = None,
        found: Found | None = None,
    ) -> Import:
        """Look at `folder`; `settings` stand for its import.toml, `found` for looking at names.

        `geometry` stands for the folder's cameras.json, and for lights.json where it has lights.
        Raises `ImportProblem` naming the file and field that are wrong or missing.
        """
        if not folder.is_dir():
            raise ImportProblem(f"{folder}: no such folder")
        settings = settings_of(folder) if settings is None else settings
        own = geometry is None
        geometry = geometry or Geometry(cameras_of(folder / "cameras.json"))
        lights = geometry.lights or lights_of(
            folder / "lights.json", {id_: c.name for id_, c in geometry.cameras.items()}
        )
        projectors = projectors_of(folder / "projectors.json")
        given = Rig(folder.name, tuple(geometry.cameras.values()), tuple(lights), projectors)
        check_metres(folder, given, "cameras" if own else "", "" if geometry.lights else "lights")
        origin = Origin.of(given.cameras)
        given = origin.rig(given)
        found = find(folder, settings, given) if found is None else found
        alone = _plates_alone(found, settings.pictures.clean_plate)
        found = replace(found, notes=(*found.notes, *alone, *origin.notes))
        cameras = {c.name: _sized(c, found) for c in given.cameras}
        lenses = {n: Lens.of(c) for n, c in cameras.items() if isinstance(c, LensModelCamera)}
        kept = tuple(lenses[n].undistorted if n in lenses else c for n, c in cameras.items())
        lit = {s.light for s in found.steps}
        rig = replace(given, cameras=kept, lights=tuple(x for x in given.lights if x.name in lit))
        head, scalp = head_of(folder / "head.obj"), scalp_of(folder / "scalp.obj")
        ball = None
        if settings.grey_ball is not None:
            if settings.units == "relative" or settings.scale != 1:
                raise ImportProblem("a grey_ball stands for `scale`: leave `units` and it out")
            try:
                ball = PlacedBall.of(settings.grey_ball, cameras)
            except ValueError as error:
                raise ImportProblem(f"grey_ball.{error}") from error
        return cls(
            folder, settings, rig, cameras, lenses, found, origin.head(head), ball,
            None if scalp is None else origin.obj(scalp), origin,
        )  # fmt: skip

    @property
    def missing(self) -> list[tuple[Step, str]]:
        """Frames that no file is for."""
        return [
            (s, c)
            for s in self.found.steps
            for c in self.shot
            if (s.index, c) not in self.found.frames
        ]

    @property
    def relative(self) -> bool:
        """Whether nothing says what the pictures' numbers are in W/(sr m²)."""
        if self.ball is not None:
            return False
        if self.settings.units is not None:
            return self.settings.units == "relative"
        files = [p for b in self.found.frames.values() for p in b.values()]
        return any(p.suffix.lower() != ".exr" for p in files)

    def counts(self) -> dict[str, Any]:
        """What was understood, as numbers."""
        kinds = Counter(s.kind for s in self.found.steps)
        brackets = Counter(len(b) for b in self.found.frames.values())
        return {
            "cameras": len(self.shot),
            "lights": len(self.rig.lights),
            "steps": dict(kinds),
            "frames": len(self.found.frames),
            "missing": len(self.missing),
            "exposures_per_frame": dict(sorted(brackets.items())),
            "clean_plates": len(self.found.plates),
            "flat_fields": len(self.found.flats),
            "hair_masks": len(self.found.hair),
            "subject_masks": len(self.found.subjects),
            "relative": self.relative,
        }

    def said(self) -> list[str]:
        """`counts` where there is any, and the sizes and first files of each camera, for people."""
        counts = self.counts()
        relative, brackets = counts.pop("relative"), counts.pop("exposures_per_frame")
        counts["steps"] = ", ".join(f"{n} {kind}" for kind, n in counts["steps"].items())
        lines = [f"{what.replace('_', ' ')}: {n}" for what, n in counts.items() if n]
        if set(brackets) != {1}:
            told = ", ".join(f"{k} of {n} frames" for k, n in brackets.items())
            lines.append(f"exposures merged: {told}")
        lines.append(f"units: {'relative' if relative else 'W/(sr m²)'}")
        for name, camera in self.shot.items():
            frames = [b for (_, c), b in self.found.frames.items() if c == name]
            first = (
                next(iter(frames[0].values())).relative_to(self.folder) if frames else "no picture"
            )
            size = f"{camera.width}x{camera.height}"
            lines.append(f"{name}: {len(frames)} frames of {size}, {first}, …")
        return lines

    def masks(self, camera: str) -> tuple[Bools | None, Bools | None]:
        """The user's masks `(H, W)` of hair and of the subject."""
        given = self.found.hair.get(camera), self.found.subjects.get(camera)
        hair, subject = (None if p is None else _mask(p, self.shot[camera]) for p in given)
        return hair, subject

    def write(self, out: Path, progress: Progress = silent) -> Capture:
        """The capture `out`, a new or empty folder; nothing is left of it where a file is broken.

        A frame that no file is for is missing, with its reason. Where there are clean plates they
        tell the subject from the background, and are taken off what is not the subject.
        """
        subjects = self._subjects(progress)
        masks = {n: _mask(p, self.shot[n]) for n, p in self.found.hair.items()}
        strength, lit = self._strength, [*self.found.notes, *self._ball_says]
        if strength != 1:
            lit.append(
                f"the lights' intensities are multiplied by {strength:.3g}, by which the subject "
                f"reflects {LIKELY:.0%} of their light: a guess, of brown hair and fair skin"
            )
        lights = tuple(replace(x, intensity=strength * x.intensity) for x in self.rig.lights)
        said: dict[str, Any] = {"notes": lit}
        said["relative"] = self.relative
        if self.origin.moved:
            said["origin"] = self.origin.point.tolist()
        plan = {"steps": self.found.steps, "imported_from": self.folder.name, "import": said}
        writer = CaptureWriter.create(
            out, replace(self.rig, lights=lights), plan,
            masks=self._undistorted(masks), head=self.head,
            subjects=self._undistorted(subjects),
        )  # fmt: skip
        frames, light = [(s, c) for s in self.found.steps for c in self.shot], False
        try:
            if self.scalp is not None:
                write_whole(out / "scalp.obj", self.scalp.encode())
            for k, (step, camera) in enumerate(frames):
                if bracket := self.found.frames.get((step.index, camera)):
                    merged = self.frame(bracket, camera)
                    light |= step.kind != "dark" and bool((merged.radiance > 0).any())
                    plate = self.found.plates.get((step.light, camera))
                    if plate is not None and step.kind == "olat" and camera in subjects:
                        behind = ~subjects[camera][..., None] * self.frame(plate, camera).radiance
                        merged = Merged(**vars(merged) | {"radiance": merged.radiance - behind})
                    image, full = self._resampled(merged, camera).marked()
                    scales = {"full_scale": full, "count_scale": merged.quantum}
                    writer.write_frame(step, camera, image, **scales)
                else:
                    writer.record_missing(step, camera, reason="no file is called after it")
                progress("importing pictures", (k + 1) / len(frames))
            if not light:
                raise ImportProblem(
                    f"{self.folder}: no pixel of any picture is above black: are these the right "
                    "files, and is `black` right?"
                )
            writer.finish("completed", {"imported_from": self.folder.name})
        except BaseException:
            writer.close()
            shutil.rmtree(out)
            raise
        return Capture(out)

    def frame(self, bracket: Bracket, camera: str) -> Merged:
        """The files of one frame, merged, in the pixels of the pictures. Raises `ImportProblem`."""
        return self._merged(bracket, camera, self._scale.value)

    def _merged(self, bracket: Bracket, camera: str, scale: float) -> Merged:
        size = (self.shot[camera].width, self.shot[camera].height)
        try:
            pictures = {s: read_picture(p, self.settings.sensor, size) for s, p in bracket.items()}
        except PictureError as error:
            raise ImportProblem(str(error)) from error
        merged = merge(pictures, scale)
        return flattened(merged, self._flats[camera]) if camera in self._flats else merged

    @cached_property
    def _scale(self) -> Scale:
        """The user's scale, or the grey ball's, by `LOOKS` frames at most."""
        if self.ball is None:
            return Scale(self.settings.scale, 0.0, ())
        factors = []
        for step, camera in self._some(self.ball.seen):
            merged = self._merged(self.found.frames[step.index, camera], camera, 1.0)
            light = self.rig.light(str(step.light))
            image, bad = merged.radiance, merged.saturated
            factors.append(self.ball.factor(self.shot[camera], light, image, bad))
        try:
            return Scale.of([f for f in factors if f is not None])
        except ValueError as error:
            raise ImportProblem(f"grey_ball: {error}") from error

    @cached_property
    def _strength(self) -> float:
        """By what the lights are stronger than their file says, for pictures in relative units."""
        if not self.relative or self.settings.scale != 1:
            return 1.0
        return likely_strength(
            (self.rig.light(str(s.light)), self.frame(self.found.frames[s.index, c], c).radiance)
            for s, c in self._some(self.shot)
        )

    def _some(self, cameras: Iterable[str]) -> list[tuple[Step, str]]:
        """At most `LOOKS` frames of these cameras under single lights, at random: every so many
        would be always the same camera's."""
        shown = [
            (step, camera)
            for step, camera in product(self.found.steps, cameras)
            if step.kind == "olat" and (step.index, camera) in self.found.frames
        ]
        return [shown[k] for k in np.random.default_rng(0).permutation(len(shown))[:LOOKS]]

    @property
    def _ball_says(self) -> list[str]:
        if self.ball is None:
            return []
        where, scale = ", ".join(f"{x:.3f}" for x in self.ball.center), self._scale
        said = f"grey ball: {1e3 * self.ball.radius:.0f} mm in radius at ({where}) m; a full "
        said += f"channel at 1 s is {scale.value:.4g} W/(sr m²), standard error {scale.error:.1%}"
        if all((x.intensity == 1).all() for x in self.rig.lights):
            said += ", of lights of 1 W/sr each, as the lights' file gives no intensities"
        return [said, *self._scale.notes]

    @cached_property
    def _flats(self) -> Mapping[str, Floats]:
        out = {}
        for camera, path in self.found.flats.items():
            size = (self.shot[camera].width, self.shot[camera].height)
            try:
                picture = read_picture(path, self.settings.sensor, size)
            except PictureError as error:
                raise ImportProblem(str(error)) from error
            light, full = picture.light, float(picture.saturated.mean())
            if full > FLAT_FULL:
                raise ImportProblem(
                    f"{path}: a flat field must not saturate, {full:.0%} of it does: shoot it at a "
                    "shorter exposure"
                )
            mean = light.mean(axis=(0, 1))
            if not (mean > 0).all():
                raise ImportProblem(f"{path}: a flat field shows light in every channel")
            out[camera] = light / mean
        return out

    def _subjects(self, progress: Progress) -> dict[str, Bools]:
        """The subject's pixels, of the user or else by clean plates, in those of the pictures."""
        out = {n: _mask(p, self.shot[n]) for n, p in self.found.subjects.items()}
        by_plates = {}
        for camera in {c for _, c in self.found.plates} - set(out):
            pairs, told = _with_plates(self.found, camera), Unchanged()
            for k, (picture, plate) in enumerate(pairs):
                told.add(self.frame(picture, camera), self.frame(plate, camera))
                progress("comparing with clean plates", (k + 1) / len(pairs))
            if pairs:
                by_plates[camera] = told.subject()
        if by_plates and not any(mask.any() for mask in by_plates.values()):
            raise ImportProblem(
                f"pictures.clean_plate = {self.settings.pictures.clean_plate!r}: no pixel of a "
                "frame differs from its clean plate: are they of the stage without the subject?"
            )
        return out | by_plates

    def _undistorted(self, masks: Mapping[str, Bools]) -> dict[str, Bools]:
        return {
            n: self.lenses[n].undistort_mask(m) if n in self.lenses else m for n, m in masks.items()
        }

    def _resampled(self, merged: Merged, camera: str) -> Merged:
        lens = self.lenses.get(camera)
        if lens is None:
            return merged
        images = {
            "radiance": lens.undistort(merged.radiance),
            "saturated": lens.undistort_any(merged.saturated),
            "noise": lens.undistort(merged.noise),
        }
        return Merged(**vars(merged) | images)


def _with_plates(found: Found, camera: str) -> list[tuple[Bracket, Bracket]]:
    """The camera's frames that a clean plate is of the same light as, and these plates."""
    out = []
    for step in found.steps:
        light = step.light if step.kind == "olat" else None
        picture, plate = found.frames.get((step.index, camera)), found.plates.get((light, camera))
        if picture and plate and step.kind in ("olat", "all_on"):
            out.append((picture, plate))
    return out


def _plates_alone(found: Found, pattern: str | None) -> list[str]:
    """A note on the cameras whose clean plates can be held against no frame."""
    cameras = sorted({c for _, c in found.plates if not _with_plates(found, c)})
    if not cameras:
        return []
    return [
        f"{', '.join(cameras)}: the clean plates (pictures.clean_plate = {pattern!r}) are under no "
        "light of a frame, and tell nothing: name single lights by {light}; plates without it go "
        "with `all_on`"
    ]


def _sized(camera: Camera, found: Found) -> Camera:
    """`camera` for the size that its first picture has; as it is where there is none."""
    for (_, name), bracket in found.frames.items():
        if name == camera.name:
            path = next(iter(bracket.values()))
            try:
                return resized(camera, *picture_size(path))
            except PlacementError as error:
                raise ImportProblem(f"{path}: {error}") from error
            except PictureError as error:
                raise ImportProblem(str(error)) from error
    return camera


def _mask(path: Path, camera: Camera) -> Bools:
    """A mask `(H, W)` in the pixels of the pictures, half grey and above."""
    expected = (camera.width, camera.height)
    try:
        found = picture_size(path)
    except PictureError as error:
        raise ImportProblem(str(error)) from error
    how = AS_STORED | cv2.IMREAD_GRAYSCALE
    image = cv2.imread(str(path), how) if found == expected else None
    if image is None:
        raise ImportProblem(f"{path}: expected a PNG of {expected} pixels, got {found}")
    try:
        mask = half_grey(np.asarray(image, np.uint8))
        check_alpha(path.read_bytes(), mask)
        return mask
    except ValueError as error:
        raise ImportProblem(f"{path}: {error}") from error
