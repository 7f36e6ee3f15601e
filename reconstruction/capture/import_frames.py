"""Frames of a folder to import: exposures merged, flat-fielded, scaled to radiance."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path

import numpy as np

from reconstruction.arrays import Bools, Floats
from reconstruction.capture.exposures import BackgroundPixels, Merged, flattened, merge
from reconstruction.capture.grey_ball import PlacedBall, Scale
from reconstruction.capture.import_matching import Bracket, Found
from reconstruction.capture.import_settings import ImportProblem, ImportSettings
from reconstruction.capture.light_patterns import LightPatterns
from reconstruction.capture.likely_lights import likely_strength
from reconstruction.capture.records import Step
from reconstruction.files.encoded import PictureError
from reconstruction.files.masks import read_mask
from reconstruction.files.pictures import Picture, read_picture
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.rig import Rig
from reconstruction.report.report import Progress, silent

FLAT_FULL = 0.01
"""Share of a flat field that may be saturated: specks."""
SAMPLED_FRAMES = 48
"""Frames read for the scale of a grey ball or the strength of the lights, drawn at random."""


@dataclass(frozen=True, eq=False)
class ImportedFrames:
    """Reads the frames `found` of the cameras `shot`, in the pixels of the images.

    `rig` has the lights; `ball` is a grey ball that determines the radiometric scale.
    """

    settings: ImportSettings
    shot: Mapping[str, Camera]
    found: Found
    rig: Rig
    ball: PlacedBall | None = None
    patterns: LightPatterns | None = None

    @property
    def relative(self) -> bool:
        """Whether the radiometric scale of the images is unknown."""
        if self.ball is not None:
            return False
        if self.settings.units is not None:
            return self.settings.units == "relative"
        files = [p for b in self.found.frames.values() for p in b.values()]
        return any(p.suffix.lower() != ".exr" for p in files)

    def frame(self, bracket: Bracket, camera: str) -> Merged:
        """The files of one frame, merged. Raises `ImportProblem`."""
        return self._merged(bracket, camera, self._scale.value)

    def _merged(self, bracket: Bracket, camera: str, scale: float) -> Merged:
        merged = merge({s: self._picture(p, camera) for s, p in bracket.items()}, scale)
        return flattened(merged, self._flats[camera]) if camera in self._flats else merged

    def values(self, path: Path, camera: str) -> Picture:
        """The values of a file, 1 at white, not decoded to light. Raises `ImportProblem`."""
        return self._picture(path, camera, values_only=True)

    def _picture(self, path: Path, camera: str, values_only: bool = False) -> Picture:
        shot, sensor = self.shot[camera], self.settings.sensor
        aspect = float(shot.K[1, 1] / shot.K[0, 0])
        try:
            return read_picture(path, sensor, (shot.width, shot.height), aspect, values_only)
        except PictureError as error:
            raise ImportProblem(str(error)) from error

    @cached_property
    def _scale(self) -> Scale:
        """The user's scale, or that of the grey ball."""
        if self.ball is None:
            return Scale(self.settings.scale, 0.0, ())
        factors = []
        for step, camera in self._sample(self.ball.cameras):
            merged = self._merged(self.found.frames[step.index, camera], camera, 1.0)
            light = self.rig.light(str(step.light))
            image, bad = merged.radiance, merged.saturated
            factors.append(self.ball.factor(self.shot[camera], light, image, bad))
        try:
            return Scale.of([f for f in factors if f is not None])
        except ValueError as error:
            raise ImportProblem(f"grey_ball: {error}") from error

    @cached_property
    def light_factor(self) -> float:
        """Factor on the lights' intensities for images in relative units, else 1."""
        if not self.relative or self.settings.scale != 1:
            return 1.0
        pattern = self.patterns.pattern if self.patterns else lambda name, rig: rig.light(name)
        return likely_strength(
            (
                pattern(str(s.lighting), self.rig),
                self.frame(self.found.frames[s.index, c], c).radiance,
            )
            for s, c in self._sample(self.shot, "pattern" if self.patterns else "olat")
        )

    def _sample(self, cameras: Iterable[str], kind: str = "olat") -> list[tuple[Step, str]]:
        """`SAMPLED_FRAMES` random frames of one kind of these cameras: every n-th frame would
        always be of the same camera."""
        frames = [
            (step, camera)
            for step, camera in product(self.found.steps, cameras)
            if step.kind == kind and (step.index, camera) in self.found.frames
        ]
        order = np.random.default_rng(0).permutation(len(frames))
        return [frames[k] for k in order[:SAMPLED_FRAMES]]

    @property
    def ball_notes(self) -> list[str]:
        """The grey ball's position and scale, for the user."""
        if self.ball is None:
            return []
        where, scale = ", ".join(f"{x:.3f}" for x in self.ball.center), self._scale
        note = f"grey ball: radius {1e3 * self.ball.radius:.0f} mm at ({where}) m; a full channel "
        note += f"at 1 s is {scale.value:.4g} W/(sr m²), standard error {scale.error:.1%}"
        if all((x.intensity == 1).all() for x in self.rig.lights):
            note += ", for lights of 1 W/sr each, as the file of lights has no intensities"
        return [note, *self._scale.notes]

    @cached_property
    def _flats(self) -> Mapping[str, Floats]:
        out = {}
        for camera, path in self.found.flats.items():
            picture = self._picture(path, camera)
            light, full = picture.light, float(picture.saturated.mean())
            if full > FLAT_FULL:
                raise ImportProblem(
                    f"{path}: {full:.0%} of the flat field is saturated, expected at most "
                    f"{FLAT_FULL:.0%}: capture it at a shorter exposure"
                )
            mean = light.mean(axis=(0, 1))
            if not (mean > 0).all():
                raise ImportProblem(f"{path}: a channel of the flat field is black")
            out[camera] = light / mean
        return out

    def subjects(self, progress: Progress = silent) -> dict[str, Bools]:
        """Masks `(H, W)` of the subject by camera: the user's, else from clean plates."""
        out = {n: read_user_mask(p, self.shot[n]) for n, p in self.found.subjects.items()}
        by_plates = {}
        for camera in {c for _, c in self.found.plates} - set(out):
            pairs, background = frames_with_plates(self.found, camera), BackgroundPixels()
            for k, (picture, plate) in enumerate(pairs):
                background.add(self.frame(picture, camera), self.frame(plate, camera))
                progress("comparing with clean plates", (k + 1) / len(pairs))
            if pairs:
                by_plates[camera] = background.subject()
        if by_plates and not any(mask.any() for mask in by_plates.values()):
            raise ImportProblem(
                f"pictures.clean_plate = {self.settings.pictures.clean_plate!r}: no pixel of a "
                "frame differs from its clean plate: do the plates show the subject?"
            )
        return out | by_plates


def frames_with_plates(found: Found, camera: str) -> list[tuple[Bracket, Bracket]]:
    """The camera's frames that have a clean plate under the same light, and these plates."""
    out = []
    for step in found.steps:
        light = step.light if step.kind == "olat" else None
        picture, plate = found.frames.get((step.index, camera)), found.plates.get((light, camera))
        if picture and plate and step.kind in ("olat", "all_on"):
            out.append((picture, plate))
    return out


def notes_on_plates(found: Found, pattern: str | None) -> list[str]:
    """A note on the cameras whose clean plates match no frame."""
    cameras = sorted({c for _, c in found.plates if not frames_with_plates(found, c)})
    if not cameras:
        return []
    return [
        f"{', '.join(cameras)}: no frame has the light of a clean plate (pictures.clean_plate = "
        f"{pattern!r}), the plates are not used: name the light in the pattern by {{light}}; "
        "plates without it belong to `all_on`"
    ]


def read_user_mask(path: Path, camera: Camera) -> Bools:
    """A mask `(H, W)` in the pixels of the images, half grey and above. Raises `ImportProblem`."""
    try:
        return read_mask(path, camera.width, camera.height)
    except (ValueError, OSError) as error:
        raise ImportProblem(str(error)) from error
