"""Import of other captures: a folder of cameras, lights and images becomes a `Capture`.

folder/
  cameras.json      {"cameras": [{"id", "width", "height", "K", "R", "t"}, ...]}
  lights.json       {"lights": [{"id", "position", "intensity", "colocated_camera"}, ...]}, optional
  patterns.csv      a table of patterns of lights (`light_patterns`), or patterns.json, optional
  projectors.json   {"projectors": [...]} as in a capture's rig.json, optional
  import.toml       names and encoding of the images (`ImportSettings`), optional
  images/<camera>/<light>.*      the image under that light alone, unless import.toml has a pattern
  images/<camera>/<pattern>.*    with a table of patterns: the image under that pattern
  images/<camera>.*              without lights.json: the photograph under constant light
  masks/<camera>.png             hair masks, optional
  subjects/<camera>.png          masks of hair, head and body, optional
  head.obj                       the head's mesh in the same frame, optional
  scalp.obj                      digitised points of the scalp in the same frame, optional

Conventions are those of `Camera` and `Light`: OpenCV, metres, pixel centres at integers, W/sr. An
`id` is a string, the name of the folder or file, or a number n for `cam_0n` and `light_0n` (at
least two digits). `colocated_camera` is a camera's id or null.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from reconstruction.arrays import Bools
from reconstruction.capture.exposures import Merged
from reconstruction.capture.folder import Capture
from reconstruction.capture.grey_ball import PlacedBall
from reconstruction.capture.import_frames import (
    ImportedFrames,
    notes_on_plates,
    read_user_mask,
)
from reconstruction.capture.import_geometry import Geometry
from reconstruction.capture.import_matching import Found, find
from reconstruction.capture.import_origin import Origin
from reconstruction.capture.import_settings import (
    SETTINGS,
    ImportProblem,
    ImportSettings,
    read_settings,
)
from reconstruction.capture.import_tables import (
    check_metres,
    head_of,
    lights_of,
    own_geometry,
    projectors_of,
    scalp_of,
)
from reconstruction.capture.light_patterns import (
    TABLES,
    LightPatterns,
    PatternError,
    read_patterns,
)
from reconstruction.capture.likely_lights import LIKELY
from reconstruction.capture.records import Step
from reconstruction.capture.response_check import ResponseCheck, check_response
from reconstruction.capture.writer import CaptureWriter
from reconstruction.files.durable import write_whole
from reconstruction.files.encoded import PictureError
from reconstruction.files.pictures import picture_size
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lens import Lens
from reconstruction.geometry.lens_models import LensModelCamera
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.placement import PlacementError, metres, resized
from reconstruction.geometry.rig import Rig
from reconstruction.geometry.world_frame import WorldFrame
from reconstruction.report.report import Progress, silent


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
    """The settings in `file` or the folder's import.toml, else defaults. Raises `ImportProblem`."""
    own = folder / SETTINGS
    if file is None and not own.is_file():
        return ImportSettings()
    return read_settings(file or own)


@dataclass(frozen=True, eq=False)
class Import:
    """A folder to import, of which only file names and image sizes have been read.

    `shot` are the cameras of the images, by name; `lenses` those of cameras whose images are
    undistorted, since a rig cannot store their lens model; `rig` is the capture's; `ball` is a grey
    ball. All of them, `head` and `scalp` (the text of scalp.obj) are relative to `origin`. Results
    come back in the frame and unit `world` of the files. `preset`: the layout is a published set's.
    `patterns` are those of the images.
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
    world: WorldFrame = field(default_factory=WorldFrame)
    preset: bool = False
    patterns: LightPatterns | None = None

    @classmethod
    def of(
        cls,
        folder: Path,
        geometry: Geometry | None = None,
        settings: ImportSettings | None = None,
        found: Found | None = None,
    ) -> Import:
        """Match the files in `folder`.

        `settings` replaces its import.toml, `found` the matching of file names, `geometry` its
        cameras.json and, if it has lights, lights.json. Raises `ImportProblem` naming the file and
        the field that is wrong or missing.
        """
        if not folder.is_dir():
            raise ImportProblem(f"{folder}: no such folder")
        settings = settings_of(folder) if settings is None else settings
        own = geometry is None
        geometry = geometry or own_geometry(folder, settings.geometry.placement)
        lights = geometry.lights or lights_of(
            folder / "lights.json", {id_: c.name for id_, c in geometry.cameras.items()}
        )
        projectors = projectors_of(folder / "projectors.json")
        given = Rig(folder.name, tuple(geometry.cameras.values()), tuple(lights), projectors)
        of_lights = "lights" if lights and (own or not geometry.lights) else ""
        check_metres(folder, given, "cameras" if own else "", of_lights)
        origin = Origin.of(given.cameras)
        given = origin.rig(given)
        preset = found is not None
        used = {s.pattern for s in found.steps if s.pattern} if found else ()
        patterns = _patterns(folder, settings, given, used)
        found = find(folder, settings, given, patterns) if found is None else found
        alone = notes_on_plates(found, settings.pictures.clean_plate)
        doubts = geometry.notes if own else []
        found = replace(found, notes=(*found.notes, *doubts, *alone, *origin.notes))
        cameras = {c.name: _sized(c, found) for c in given.cameras}
        lenses = {n: Lens.of(c) for n, c in cameras.items() if isinstance(c, LensModelCamera)}
        kept = tuple(lenses[n].undistorted if n in lenses else c for n, c in cameras.items())
        lit = {s.light for s in found.steps} | set(patterns.lights if patterns else ())
        rig = replace(given, cameras=kept, lights=tuple(x for x in given.lights if x.name in lit))
        placement = geometry.placement
        world = WorldFrame(metres(placement.unit), placement.up or "z")
        head, scalp = head_of(folder / "head.obj", world), scalp_of(folder / "scalp.obj", world)
        ball = None
        if settings.grey_ball is not None:
            if settings.units == "relative" or settings.scale != 1:
                raise ImportProblem(
                    "grey_ball determines the scale: remove `units` and `scale` from import.toml"
                )
            try:
                ball = PlacedBall.of(settings.grey_ball, cameras)
            except ValueError as error:
                raise ImportProblem(f"grey_ball.{error}") from error
        return cls(
            folder, settings, rig, cameras, lenses, found, origin.head(head), ball,
            None if scalp is None else origin.obj(scalp), origin,
            replace(world, origin=origin.stored), preset, patterns,
        )  # fmt: skip

    @property
    def missing(self) -> list[tuple[Step, str]]:
        """Frames without a file."""
        return [
            (s, c)
            for s in self.found.steps
            for c in self.shot
            if (s.index, c) not in self.found.frames
        ]

    @cached_property
    def response(self) -> ResponseCheck:
        """The images' encoding, checked by fully lit frames, which are read."""
        stated = self.settings.sensor.response is not None and not self.preset
        return check_response(self._reader(self.settings), not stated)

    @cached_property
    def frames(self) -> ImportedFrames:
        """The reader of the frames."""
        return self._reader(replace(self.settings, sensor=self.response.sensor))

    def _reader(self, settings: ImportSettings) -> ImportedFrames:
        return ImportedFrames(settings, self.shot, self.found, self.rig, self.ball, self.patterns)

    def counts(self) -> dict[str, Any]:
        """What was recognised, as numbers."""
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
            "relative": self.frames.relative,
        }

    def summary(self) -> list[str]:
        """The nonzero `counts`, and the image size and first file of each camera, as text."""
        counts = self.counts()
        relative, brackets = counts.pop("relative"), counts.pop("exposures_per_frame")
        counts["steps"] = ", ".join(f"{n} {kind}" for kind, n in counts["steps"].items())
        lines = [f"{what.replace('_', ' ')}: {n}" for what, n in counts.items() if n]
        if set(brackets) != {1}:
            merged = ", ".join(f"{k} of {n} frames" for k, n in brackets.items())
            lines.append(f"exposures merged: {merged}")
        lines.append(f"units: {'relative' if relative else 'W/(sr m²)'}")
        for name, camera in self.shot.items():
            frames = [b for (_, c), b in self.found.frames.items() if c == name]
            first = (
                next(iter(frames[0].values())).relative_to(self.folder) if frames else "no image"
            )
            size = f"{camera.width}x{camera.height}"
            lines.append(f"{name}: {len(frames)} frames of {size}, {first}, …")
        return lines

    def masks(self, camera: str) -> tuple[Bools | None, Bools | None]:
        """The user's masks `(H, W)` of hair and of the subject."""
        given = self.found.hair.get(camera), self.found.subjects.get(camera)
        hair, subject = (None if p is None else read_user_mask(p, self.shot[camera]) for p in given)
        return hair, subject

    def write(self, out: Path, progress: Progress = silent) -> Capture:
        """Write the capture `out`, a new or empty folder, which is removed if a file is broken.

        A frame without a file is recorded as missing. Clean plates separate the subject from the
        background and are subtracted from the background.
        """
        reader = self.frames
        subjects = reader.subjects(progress)
        masks = {n: read_user_mask(p, self.shot[n]) for n, p in self.found.hair.items()}
        factor = reader.light_factor
        notes = [*self.found.notes, *self.response.notes, *reader.ball_notes]
        if factor != 1:
            notes.append(
                f"relative units: light intensities are multiplied by {factor:.3g}, so that the "
                f"subject reflects {LIKELY:.0%} of the light, as brown hair and fair skin do"
            )
        lights = tuple(replace(x, intensity=factor * x.intensity) for x in self.rig.lights)
        frame = self.world.to_dict()
        record = {"notes": notes, "relative": reader.relative, "frame": frame}
        plan = {"steps": self.found.steps, "imported_from": self.folder.name, "import": record}
        if self.patterns is not None:
            plan["patterns"] = self.patterns.to_dict()
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
                    merged = reader.frame(bracket, camera)
                    light |= step.kind != "dark" and bool((merged.radiance > 0).any())
                    plate = self.found.plates.get((step.light, camera))
                    if plate is not None and step.kind == "olat" and camera in subjects:
                        background = reader.frame(plate, camera).radiance
                        behind = ~subjects[camera][..., None] * background
                        merged = Merged(**vars(merged) | {"radiance": merged.radiance - behind})
                    image, full = self._resampled(merged, camera).marked()
                    scales = {"full_scale": full, "count_scale": merged.quantum}
                    writer.write_frame(step, camera, image, **scales)
                else:
                    writer.record_missing(step, camera, reason="no file matches it")
                progress("importing images", (k + 1) / len(frames))
            if not light:
                raise ImportProblem(
                    f"{self.folder}: no pixel of any image is above black: check the files and "
                    "`black` in import.toml"
                )
            writer.finish("completed", {"imported_from": self.folder.name})
        except BaseException:
            writer.close()
            shutil.rmtree(out)
            raise
        return Capture(out)

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


def _patterns(
    folder: Path, settings: ImportSettings, rig: Rig, used: Collection[str]
) -> LightPatterns | None:
    """The table of the settings or the folder with the patterns `used`, None without a table."""
    named = [p for p in (settings.patterns, *TABLES) if p is not None]
    tables = [folder / p for p in named if settings.patterns == p or (folder / p).is_file()]
    if not tables:
        if used:
            raise ImportProblem(
                f"{folder}: each image is lit by a pattern of many lamps: give a table of their "
                f"weights (--patterns FILE) with the rows {', '.join(sorted(used))}, or import "
                "images of single lights"
            )
        return None
    try:
        found = read_patterns(tables[0], [x.name for x in rig.lights])
    except PatternError as error:
        raise ImportProblem(str(error)) from error
    if missing := sorted(set(used) - set(found.names)):
        raise ImportProblem(f"{tables[0]}: no row of the pattern {missing[0]}")
    return found


def _sized(camera: Camera, found: Found) -> Camera:
    """`camera` scaled to the size of its first image, if it has one."""
    for (_, name), bracket in found.frames.items():
        if name == camera.name:
            path = next(iter(bracket.values()))
            try:
                return resized(camera, *picture_size(path, (camera.width, camera.height)))
            except PlacementError as error:
                raise ImportProblem(f"{path}: {error}") from error
            except PictureError as error:
                raise ImportProblem(str(error)) from error
    return camera
