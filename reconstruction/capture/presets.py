"""Layouts of public OLAT sets: frames, cameras and lights.

FaceOLAT (github.com/prraoo/FaceOLAT), HumanOLAT (github.com/TMT22/HumanOLAT) and OpenIllumination
(huggingface.co/datasets/OpenIllumination/OpenIllumination, open_illumination.py), as their pages
and tools describe them; tested on imitations only. In the first two all lights are on between
single lights, so that the subject can be tracked; the numbers of these frames differ between takes
by one or more.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from reconstruction.arrays import Array
from reconstruction.capture.import_geometry import Geometry
from reconstruction.capture.import_matching import Found
from reconstruction.capture.import_settings import ImportSettings
from reconstruction.capture.lit_pattern import PresetProblem, find_pattern, with_fully_lit
from reconstruction.capture.records import Step, StepKind
from reconstruction.containment import plain_file
from reconstruction.files.cameras import CameraFile, read_cameras
from reconstruction.files.cameras.nerfstudio import read_transforms
from reconstruction.files.encoded import FORMATS
from reconstruction.files.lights import LightFile, read_lights
from reconstruction.files.pictures import Sensor, picture_size, read_picture
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.placement import (
    PlacementOptions,
    check_cameras,
    check_lights,
    placed,
    placed_lights,
)
from reconstruction.reading import read_json

Preset = Literal["faceolat", "humanolat", "openillumination"]
PATTERNS = set(range(1, 14))
"""Numbers of OpenIllumination's images under patterns of many lamps."""
SRGB = Sensor(response="srgb")
HATCH = (
    *(178, 179, 208, 209, 210, 237, 238, 239, 240, 267, 268, 269, 270, 271),
    *(295, 296, 297, 298, 319, 320, 321),
)
"""Lights on the door of HumanOLAT's stage, from 0: their positions are inaccurate."""


@dataclass(frozen=True)
class TakeFrame:
    """One file: kind of step, `light` (single lights) or pattern, and `number` in the take."""

    kind: StepKind
    number: int
    camera: str
    path: Path
    light: str | None = None


@dataclass(frozen=True)
class Take:
    """One take; `subjects` are masks of the subject by camera, `sensor` the files' encoding,
    `exposure` that of its frames relative to other takes'."""

    geometry: Geometry
    frames: list[TakeFrame]
    subjects: Mapping[str, Path] = field(default_factory=dict)
    sensor: Sensor = SRGB
    exposure: float = 1.0


@dataclass(frozen=True)
class PresetFiles:
    """The user's folder, take, and files of `cameras` and `lights` outside the folder."""

    folder: Path
    take: str | None = None
    cameras: Path | None = None
    lights: Path | None = None


Files = dict[str, dict[int, Path]]
"""Files by camera and by the number at the end of their names."""
Mean = Callable[[Path], float]
"""Mean light of an image, in any unit."""


def read_preset(
    preset: Preset, files: PresetFiles, mean: Mean, given: Mapping[str, Any] = MappingProxyType({})
) -> Take:
    """The take in `files.folder`; `given` fields of `PlacementOptions` replace the preset's.

    Raises `ValueError` (`PresetProblem`, and those of camera and light files).
    """
    if not files.folder.is_dir():
        raise PresetProblem(f"{files.folder}: no such folder")
    readers = {"faceolat": _faceolat, "humanolat": _humanolat}
    return (readers | {"openillumination": _openillumination})[preset](files, mean, given)


def understood(take: Take) -> tuple[ImportSettings, Found]:
    """The take as arguments of `Import.of`: a step for each number, in capture order."""
    rank = {(f.number, f.kind, f.light): f for f in take.frames}
    keys = sorted(rank, key=lambda k: (k[0], k[1], k[2] or ""))
    seconds = take.exposure
    steps = [Step(i, kind, seconds, light=light) for i, (_, kind, light) in enumerate(keys)]
    steps = [replace(s, light=None, pattern=s.light) if s.kind == "pattern" else s for s in steps]
    at = {key: i for i, key in enumerate(keys)}
    frames = {(at[f.number, f.kind, f.light], f.camera): {seconds: f.path} for f in take.frames}
    settings = ImportSettings(sensor=take.sensor, units="relative")
    found = Found(tuple(steps), frames, {}, {}, {}, take.subjects, (), ())
    return settings, found


def mean_light(path: Path) -> float:
    """Mean linear light of an image."""
    return float(read_picture(path, Sensor(), picture_size(path)).light.mean())


def _faceolat(files: PresetFiles, mean: Mean, given: Mapping[str, Any]) -> Take:
    """`CamNN/IDxxxxx/IDxxxxx.NNNNNN.*`, and from the repository `--cameras calibration/cameras/
    NNN.xml --lights relighting/lights/light_pattern_metadata.json`, with `..._per_frame.json`.

    AVIF has light^(1/2.2) without sRGB's toe, after the colour matrix (the repository's
    color-calibration/exr2avif.py, 8e12bbb); EXR has neither. exr2avif.py takes EXR as linear,
    although extract_public.py calls REDline with `--gammaCurve 2`, sRGB: the fully lit frames of
    the take decide. Takes ID20088 to ID20116 have half the exposure
    (relighting/render_reference_envmap_relit.py, f106fe0).
    """
    taken = _takes(files, files.folder, "CamNN/ID20001/ID20001.000001.exr")
    lights = _given(files.lights, "--lights relighting/lights/light_pattern_metadata.json")
    table = lights.with_name("light_pattern_per_frame.json")
    rows = read_json(table)
    try:
        order = [int(light) - 1 for _, light in sorted((int(f), int(n)) for f, n in rows)]
    except (TypeError, ValueError) as error:
        raise PresetProblem(f"{table}: expected a list of [frame, light] ({error})") from error
    where = replace(PlacementOptions(unit="m", light_unit="mm", up="y"), **given)
    geometry = _placed(
        read_cameras(_given(files.cameras, "--cameras calibration/cameras/NNN.xml")),
        read_lights(lights),
        where,
    )
    linear = {p.suffix.lower() for paths in taken.values() for p in paths.values()} <= {".exr"}
    frames, notes = _sequence(taken, geometry, order, mean, 0)
    sensor = Sensor(response=2.2)
    if linear:
        colours = lights.parent.parent.parent / "color-calibration" / "colorcalib_exr.mat"
        sensor = Sensor(response="linear", matrix=_matrix(colours))
        if sensor.matrix is None:
            notes.append(f"{colours}: no such file, colours are not calibrated")
    name = re.search(r"/ID2(\d{4})/", frames[0].path.as_posix())
    half = name is not None and 88 <= int(name[1]) <= 116
    if half:
        notes.append("the take has half the exposure of others (ID20088 to ID20116): corrected")
    return Take(
        replace(geometry, cameras=_shot(geometry, taken), notes=[*geometry.notes, *notes]),
        frames,
        sensor=sensor,
        exposure=0.5 if half else 1.0,
    )


def _matrix(path: Path) -> Any:
    """The upper left 3 x 3 numbers of a text file of 4 x 4; None without the file."""
    if not path.is_file():
        return None
    try:
        return tuple(map(tuple, np.loadtxt(plain_file(path)).reshape(4, 4)[:3, :3].tolist()))
    except ValueError as error:
        raise PresetProblem(f"{path}: expected 4 x 4 numbers ({error})") from error


def _humanolat(files: PresetFiles, mean: Mean, given: Mapping[str, Any]) -> Take:
    """A pose: `images_processed` or `images_raw/CamNN/ID.NNN.avif`, and `../shared` of its subject.

    Processed images are undistorted; frame 0 is white light, 1 to 13 are gradients and
    environments, single lights follow from 13 or 14 on. Both have sRGB's curve: the authors'
    code/utils/avif_image_utils.py (99f3d04) decodes every AVIF by it.
    """
    folder, shared = files.folder, files.folder.parent / "shared"
    pictures = next(
        (folder / n for n in ("images_processed", "images_raw") if (folder / n).is_dir()), None
    )
    if pictures is None:
        raise PresetProblem(
            f"{folder}: expected a subject's pose, with images_processed/CamNN or images_raw/CamNN"
        )
    taken = _takes(files, pictures, "CamNN/ID.000014.avif", deep=False)
    cameras = read_cameras(files.cameras or shared / "cameras.calib")
    if pictures.name == "images_processed":
        cameras = replace(cameras, cameras=[c.pinhole() for c in cameras.cameras])
    lights = read_lights(files.lights or shared / "LSX_light_positions_aligned.pc")
    spiral = shared / "LSX3_light_z_spiral.txt"
    try:
        turns = [int(w) - 1 for w in plain_file(spiral).read_text().split()]
    except (OSError, ValueError) as error:
        raise PresetProblem(f"{spiral}: expected one light number per line ({error})") from error
    order = with_fully_lit(turns)
    where = replace(PlacementOptions(unit="mm", light_unit="m", up="y"), **given)
    geometry = _placed(cameras, lights, where)
    frames, notes = _sequence(taken, geometry, order, mean, 1)
    hatch = {geometry.lights[i].name for i in HATCH if i < len(geometry.lights)}
    kept = [light for light in geometry.lights if light.name not in hatch]
    frames = [f for f in frames if f.light not in hatch]
    notes.append(
        f"{len(hatch)} lights on the stage's door are skipped: their positions are inaccurate"
    )
    zero = _span(taken)[0]
    white = [
        TakeFrame("all_on", zero, c, paths[zero])
        for c, paths in taken.items()
        if c in geometry.cameras and zero in paths
    ]
    masks = {c: folder / "segmentations" / "masks" / "000" / f"{c}.png" for c in taken}
    return Take(
        replace(
            geometry, cameras=_shot(geometry, taken), lights=kept, notes=[*geometry.notes, *notes]
        ),
        [*white, *frames],
        {c: p for c, p in masks.items() if p.is_file()},
    )


def _openillumination(files: PresetFiles, mean: Mean, given: Mapping[str, Any]) -> Take:
    """`OLAT/NAME`: `Lights/NNN/raw_undistorted/CAMERA.JPG`, whose light is row NNN of the set's
    `light_pos.npy`; `output/transforms_*.json`; masks `output/obj_masks/CAMERA.png`. In
    `lighting_patterns/NAME` each is under a pattern, whose weights the set does not have.
    """
    folder = files.folder
    tables = sorted((folder / "output").glob("transforms_*.json"))
    lit = {int(p.name): p for p in sorted((folder / "Lights").glob("*")) if p.name.isdigit()}
    shot = {n: _pictures(p / "raw_undistorted") for n, p in lit.items()}
    if not tables or not any(shot.values()):
        raise PresetProblem(
            f"{folder}: expected output/transforms_train.json and Lights/000/raw_undistorted/A1.JPG"
        )
    of_patterns = set(lit) <= PATTERNS or folder.parent.name == "lighting_patterns"
    lights = read_lights(_given(files.lights or _above(folder, "light_pos.npy"), "--lights FILE"))
    if max(lit) >= len(lights.lights) and not of_patterns:
        raise PresetProblem(
            f"{folder}: Lights/{max(lit):03d} is beyond the {len(lights.lights)} lights of the file"
        )
    pictures = {name: path for taken in shot.values() for name, path in taken.items()}
    cameras: dict[str, Camera] = {}
    for table in tables:
        data = read_json(table)
        frames = data.get("frames") if isinstance(data, dict) else None
        if not isinstance(frames, dict) or not all(isinstance(f, dict) for f in frames.values()):
            raise PresetProblem(f"{table}: frames: expected an object by the cameras' names")
        there = {c: picture_size(pictures[c]) for c in frames if c in pictures}
        sized = {c: {**frames[c], "w": w, "h": h} for c, (w, h) in there.items()}
        read = read_transforms(table, {"frames": sized}).cameras if sized else []
        cameras |= {c.name: c for c in read}
    if not cameras:
        raise PresetProblem(f"{tables[0]}: none of the cameras {', '.join(pictures)} has a pose")
    where = replace(PlacementOptions(), **given)
    geometry = _placed(CameraFile(list(cameras.values()), axes="opengl"), lights, where)
    if where.unit == "m":
        geometry.notes.append(f"{tables[0]} has no unit: m is assumed (--unit)")
    if without := sorted(set(pictures) - set(geometry.cameras)):
        geometry.notes.append(f"{', '.join(without)}: no pose, skipped")
    names = dict(enumerate(light.name for light in geometry.lights))
    if of_patterns:
        names = {n: f"{n:03d}" for n in lit}
    elif dark := [name for n, name in names.items() if not shot.get(n)]:
        geometry.notes.append(f"{len(dark)} lights have no image and are skipped: {dark[0]}, …")
    single = [
        TakeFrame("pattern" if of_patterns else "olat", n, camera, path, names[n])
        for n, taken in shot.items()
        for camera, path in taken.items()
        if camera in geometry.cameras
    ]
    masks = {c: folder / "output" / "obj_masks" / f"{c}.png" for c in cameras}
    return Take(geometry, single, {c: p for c, p in masks.items() if p.is_file()})


def _pictures(folder: Path) -> dict[str, Path]:
    return {f.stem: f for f in sorted(folder.glob("*")) if f.suffix.lower() in FORMATS}


def _above(folder: Path, name: str) -> Path | None:
    """The nearest file of that name above `folder`."""
    return next((p / name for p in folder.resolve().parents[:3] if (p / name).is_file()), None)


def _given(path: Path | None, example: str) -> Path:
    if path is None:
        raise PresetProblem(f"give {example} from the data set's repository")
    return path


def _placed(cameras: CameraFile, lights: LightFile, where: PlacementOptions) -> Geometry:
    stand = placed(cameras.cameras, where, cameras.axes)
    notes = [*cameras.notes, *check_cameras(stand, where, cameras.axes)]
    shine = placed_lights(lights.lights, where)
    check_lights(stand, shine, where.light_unit or where.unit)
    return Geometry({c.name: c for c in stand}, shine, [*notes, *lights.notes], where)


def _takes(files: PresetFiles, root: Path, example: str, deep: bool = True) -> Files:
    """The files of the requested take."""
    folders = sorted(p for p in root.glob("Cam*") if p.is_dir())
    if not folders:
        raise PresetProblem(f"{root}: expected {example}")
    if deep:
        takes = sorted({p.name for f in folders for p in f.iterdir() if p.is_dir()})
        take = files.take or (takes[0] if len(takes) == 1 else None)
        if take not in takes:
            shown = ", ".join(takes[:8]) or "none"
            raise PresetProblem(f"{root}: give --take, one of {shown}")
        folders = [f / str(take) for f in folders]
    out: Files = {}
    for place in folders:
        paths = [p for p in place.iterdir() if p.is_file()] if place.is_dir() else []
        found = [(re.search(r"(\d+)\.[A-Za-z0-9]+$", p.name), p) for p in sorted(paths)]
        numbered = {int(match[1]): path for match, path in found if match}
        if numbered:
            out[(place.parent if deep else place).name] = numbered
    if not out:
        raise PresetProblem(f"{root}: expected {example}")
    return out


def _sequence(
    taken: Files, geometry: Geometry, order: Sequence[int], mean: Mean, skip: int
) -> tuple[list[TakeFrame], list[str]]:
    """Frames of the cameras with a pose; the pattern is located by brightness.

    The first `skip` files are not part of it. Missing files are missing frames.
    """
    highest = max(order)
    if highest >= len(geometry.lights):
        raise PresetProblem(
            f"the pattern has {highest + 1} lights, the file of lights {len(geometry.lights)}"
        )
    posed = [c for c in taken if c in geometry.cameras]
    notes = []
    if without := [c for c in taken if c not in geometry.cameras]:
        notes.append(f"{', '.join(without)}: no pose, skipped")
    if not posed:
        raise PresetProblem(f"none of the cameras {', '.join(taken)} has a pose")
    if unused := [str(c) for c in geometry.cameras if c not in taken]:
        notes.append(f"{', '.join(unused)}: no images, skipped")
    numbers = range(*_span(taken))
    pattern = find_pattern(_brightness(taken, posed, numbers, mean)[skip:], order)
    start = numbers[0] + skip + pattern.start
    first, second = (start + i for i in np.flatnonzero(np.asarray(order) < 0)[:2])
    notes.append(f"the stage is fully lit in the frames {first}, {second}, …")
    wrong = {numbers[0] + skip + i for i in pattern.wrong}
    if wrong:
        notes.append(
            f"frames {', '.join(map(str, sorted(wrong)))}: brightness contradicts the pattern, "
            "skipped"
        )
    frames = []
    for camera in posed:
        for number, light in enumerate(order, start):
            path = taken[camera].get(number)
            if path is None or number in wrong:
                continue
            name = None if light < 0 else geometry.lights[light].name
            kind: StepKind = "tracking" if light < 0 else "olat"
            frames.append(TakeFrame(kind, number, camera, path, name))
    return frames, notes


def _shot(geometry: Geometry, taken: Files) -> dict[str | int, Camera]:
    return {name: camera for name, camera in geometry.cameras.items() if name in taken}


def _span(taken: Files) -> tuple[int, int]:
    """The first number, and one past the last."""
    numbers = [n for files in taken.values() for n in files]
    if max(numbers) - min(numbers) > 10 * len(set(numbers)):
        raise PresetProblem(
            f"files are numbered from {min(numbers)} to {max(numbers)}: not one take"
        )
    return min(numbers), max(numbers) + 1


def _brightness(taken: Files, posed: Sequence[str], numbers: Sequence[int], mean: Mean) -> Array:
    """Mean brightness `(N,)` of three cameras spread over the stage, each relative to its median.

    A frame that none of them has counts as 1.
    """
    chosen = posed[:: max(1, len(posed) // 3)][:3]
    value = np.array(
        [[mean(taken[c][n]) if n in taken[c] else np.nan for n in numbers] for c in chosen]
    )
    value /= np.nanmedian(value, axis=1, keepdims=True)
    there = np.isfinite(value)
    total = np.where(there, value, 0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
    return np.where(there.any(axis=0), total, 1.0)
