"""`import.toml`."""

from __future__ import annotations

import tomllib
from dataclasses import field
from pathlib import Path
from typing import Literal

from reconstruction.capture.grey_ball import GreyBall, MirrorBalls
from reconstruction.capture.import_geometry import GeometryFiles
from reconstruction.capture.records import CaptureError
from reconstruction.files.pictures import Positive, Sensor
from reconstruction.options import BadOptions, options, parse_options

SETTINGS = "import.toml"
FIELDS = ("camera", "light", "pattern", "exposure", "projector", "row", "number")


class ImportProblem(CaptureError):
    """A folder that cannot be imported; the message names the file and the field."""


@options
class Patterns:
    """File name patterns of each kind of image, relative to the folder.

    `{camera}`, `{light}`, `{pattern}` and `{projector}` are names, or the number at the end of a
    name with any zeros before it (7, 07, light_07); `{exposure}` is seconds (`0.02`, `1-50`) or a
    key of `exposures`; `{row}` a projector's row; `{number}` the order of capture, one count for
    tracking frames and rows (lights captured once may be counted per camera); `*` is any text.
    `clean_plate` shows the stage without the subject, `flat` an evenly lit field. Without lights,
    and with a table of patterns of lights, the default `olat` is not used. Without lights `all_on`,
    `hair` and `subject` default to the first of `PHOTOGRAPHS` that match a file, with a table
    `pattern` to the first of `PATTERN_IMAGES`.
    """

    olat: str = "images/{camera}/{light}.*"
    dark: str | None = None
    all_on: str | None = None
    pattern: str | None = None
    tracking: str | None = None
    scanline: str | None = None
    clean_plate: str | None = None
    flat: str | None = None
    hair: str = "masks/{camera}.png"
    subject: str = "subjects/{camera}.png"


PATTERN_IMAGES = {"pattern": ("images/{camera}/{pattern}.*", "images/{pattern}/{camera}.*")}
PHOTOGRAPHS = {
    "all_on": ("images/{camera}.*", "images_2/{camera}.*", "image/{camera}.*"),
    "hair": (
        *("masks/{camera}.png", "masks/hair/{camera}.png", "masks_2/hair/{camera}.png"),
        "hair_mask/{camera}.png",
    ),
    "subject": (
        *("subjects/{camera}.png", "masks/body/{camera}.png", "masks_2/body/{camera}.png"),
        "mask/{camera}.png",
    ),
}
"""Photographs under constant light and their masks: hairstage, COLMAP and nerfstudio,
GaussianHaircut (run.sh, calc_masks.py), NeuralHaircut (preprocess_custom_data)."""


@options
class ImportSettings:
    """`import.toml`, field by field.

    `exposure` in seconds applies to patterns without `{exposure}`; "file" reads it from EXIF;
    `exposures` are named exposures. `first_light` is the number in a file name of the first light
    in the list; None: numbers are those at the end of the lights' names. `units` is whether a full
    channel at 1 s is `scale` W/(sr m²) or unknown; a `grey_ball` determines it instead of `scale`.
    `mirror_balls` are those by which `import --targets` finds lights.
    `patterns` is a table of `reconstruction.capture.light_patterns`, by default the folder's
    patterns.csv or patterns.json; it and the files of cameras and lights, `geometry`, are relative
    to the folder.
    """

    pictures: Patterns = Patterns()
    sensor: Sensor = Sensor()
    exposure: Positive | Literal["file"] = 1.0
    exposures: dict[str, Positive] = field(default_factory=dict)
    first_light: int | None = None
    units: Literal["radiance", "relative"] | None = None
    scale: Positive = 1.0
    grey_ball: GreyBall | None = None
    mirror_balls: MirrorBalls = MirrorBalls()
    patterns: Path | None = None
    geometry: GeometryFiles = GeometryFiles()


def read_settings(path: Path) -> ImportSettings:
    """Read `import.toml`. Raises `ImportProblem` naming the field that is wrong."""
    try:
        return parse_options(ImportSettings, tomllib.loads(path.read_text()), str(path))
    except FileNotFoundError:
        raise ImportProblem(f"{path}: no such file") from None
    except (BadOptions, UnicodeDecodeError) as error:
        raise ImportProblem(str(error)) from error
    except tomllib.TOMLDecodeError as error:
        raise ImportProblem(f"{path}: not TOML ({error})") from error
