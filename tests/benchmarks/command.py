"""What the commands of benchmarks share: options, and the data that they are about."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reconstruction import Progress
from stage_service.cli.support.commands import rig_path

DATA = "HAIRSTAGE_DATA"
"""The environment variable that names the folder of subjects which others made."""

CYCLES = "captures/cycles_wavy"
"""In that folder: a capture that Blender Cycles rendered, to be imported, with its truth."""


class LeftOut(Exception):
    """A benchmark that lacks its data; the message says what to give."""


@dataclass(frozen=True)
class Option:
    """An option of the command line, as `add_argument` takes it."""

    flag: str
    settings: dict[str, Any]


def option(flag: str, help: str, **settings: Any) -> Option:
    """An option with its help."""
    return Option(flag, {"help": help, **settings})


OUT = option("--out", "folder of the results", type=Path, default=Path("runs/bench"))
SEED = option("--seed", "of all random numbers", type=int, default=0)
QUICK = option("--quick", "as little as shows that it runs; no figures", action="store_true")
PUBLISH = option("--publish", "write docs/benchmarks/NAME.md and .json too", action="store_true")
CACHE = option("--cache", "where captures are kept", type=Path, default=Path("runs/cache"))
CAPTURE = option("--capture", f"that Cycles rendered; default: ${DATA}/{CYCLES}", type=Path)
ONLY = option("--only", "one subject")
SUBJECT = (
    option("--subject", "wavy, straight, curly or a strand file", default="wavy"),
    option("--head", "head mesh (OBJ) of a strand file", type=Path),
    option("--rig", "rig file, or the name of one of the package's", type=rig_path, default="demo"),
)


@dataclass(frozen=True)
class Benchmark:
    """A benchmark as a command.

    `run(args, progress)` leaves its results in the folder `args.out` and returns them.
    """

    run: Callable[[argparse.Namespace, Progress], dict[str, Any]]
    options: tuple[Option, ...] = ()

    def add_options(self, parser: argparse.ArgumentParser) -> None:
        """Add `--out`, `--seed`, `--quick`, `--publish` and its own, unless another one has."""
        for option in (OUT, SEED, QUICK, PUBLISH, *self.options):
            if option.flag not in parser._option_string_actions:
                parser.add_argument(option.flag, **option.settings)


def data_folder() -> Path | None:
    """The folder of subjects that others made, where one is named."""
    name = os.environ.get(DATA)
    return Path(name) if name else None


def cycles_folder(capture: Path | None) -> Path:
    """The capture that Cycles rendered. Raises `LeftOut` where it is not there."""
    folder = capture or (data_folder() or Path()) / CYCLES
    if not folder.is_dir():
        raise LeftOut(
            f"no capture at {folder}: name its folder with --capture, "
            f"or the folder that holds {CYCLES} in ${DATA}"
        )
    return folder


def within(progress: Progress, name: str, first: float = 0.0, share: float = 1.0) -> Progress:
    """`progress` of a part: says `name` first, and maps 0 to 1 onto `first` to `first + share`."""
    return lambda what, done: progress(f"{name}: {what}", first + share * done)
