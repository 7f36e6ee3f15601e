"""Text files changed at random: the same result, a sentence, or a note; nothing moved in silence.

What a program or an editor changes (blanks, line ends, comments, a byte order mark) gives the same
numbers or is refused. A lost or doubled line or word gives the same, is refused, or is noted.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path

import camera_writers as writers
import numpy as np
import pytest

from reconstruction.files.cameras import read_cameras
from reconstruction.files.lights import read_lights
from reconstruction.geometry.ies import read_ies

POINTS = np.random.default_rng(3).uniform(-0.1, 0.1, (20, 3))
LIGHTS = "id,x_mm,y_mm,z_mm\n" + "".join(f"{i},{i * 31.5},-{900 + i}.25,{i}\n" for i in range(8))
IES = """IESNA:LM-63-2002
[TEST] 4711
[MANUFAC] nobody
TILT=NONE
1 1000 2 5 1 1 2 0.1 0.1 0
0.9 0 50
0 20 45 70 90
0
1000 900 600 250.5 3
"""
Read = Callable[[], tuple[list[tuple[str, np.ndarray]], list[str]]]


def _cameras(path: Path) -> Read:
    def read():
        file = read_cameras(path)
        return sorted((c.name, c.project(POINTS)[0]) for c in file.cameras), file.notes

    return read


def _of_images(name: str):
    def make(folder: Path) -> tuple[Path, Read]:
        writers.write_colmap_text(folder / "sparse", writers.stage())
        path = folder / "sparse" / name
        kind = name.removesuffix(".txt")
        path.write_text(f"# Number of {kind}: 6\n{path.read_text()}")
        return path, _cameras(folder / "sparse")

    return make


def _easymocap(name: str):
    def make(folder: Path) -> tuple[Path, Read]:
        writers.write_easymocap(folder / "calib", writers.stage())
        return folder / "calib" / name, _cameras(folder / "calib")

    return make


def _metashape(folder: Path) -> tuple[Path, Read]:
    writers.write_rig(folder / "rig.xml", writers.stage())
    return folder / "rig.xml", _cameras(folder / "rig.xml")


def _lights(folder: Path) -> tuple[Path, Read]:
    (folder / "lights.csv").write_text(LIGHTS)

    def read():
        file = read_lights(folder / "lights.csv")
        found = [(x.name, (file.metres or 1) * x.position) for x in file.lights]
        return sorted(found, key=lambda f: f[0]), file.notes

    return folder / "lights.csv", read


def _ies(folder: Path) -> tuple[Path, Read]:
    (folder / "lamp.ies").write_text(IES)

    def read():
        angle = np.radians(np.arange(0, 90, 7.5))
        towards = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
        return [("lamp", read_ies(folder / "lamp.ies").at(towards))], []

    return folder / "lamp.ies", read


FORMATS = {
    **{name: _of_images(name) for name in ("images.txt", "cameras.txt")},
    **{name: _easymocap(name) for name in ("intri.yml", "extri.yml")},
    **{"cameras.xml": _metashape, "lights.csv": _lights, "lamp.ies": _ies},
}
LOSSY = set(FORMATS) - {"cameras.xml"}  # an element that is not there is a 0 of Metashape's


def harmless(text: str, rng: np.random.Generator, name: str) -> str:
    """`text` as other programs leave it."""
    lines = text.split("\n")
    at = int(rng.integers(1, len(lines)))
    if name.endswith("csv"):
        words = [x.replace(",", " , ") if rng.random() < 0.5 else x for x in lines]
    else:
        words = [re.sub(r"(?<=\d) (?=[-\d])", "  ", x) for x in lines]
    comment = [] if name.endswith(("ies", "xml")) else ["# by hand"]
    choices = [
        "\ufeff" + text,
        text.replace("\n", "\r\n"),
        text.rstrip("\n"),
        text + "\n\n",
        "\n".join(x + "  " for x in lines),
        "\n".join(words),
        "\n".join([*lines[:at], *comment, *lines[at:]]),
        "\n".join([*lines[:at], "", *lines[at:]]),
    ]
    return choices[rng.integers(len(choices))]


def lossy(text: str, rng: np.random.Generator) -> str:
    """`text` without a line or a word, with a line twice, or cut at its end."""
    lines = text.split("\n")
    at = int(rng.integers(len(lines)))
    words = list(re.finditer(r"[^\s,]+", text))
    word = words[rng.integers(len(words))]
    choices = [
        "\n".join(lines[:at] + lines[at + 1 :]),
        "\n".join([*lines[: at + 1], *lines[at:]]),
        text[: word.start()] + text[word.end() :],
        text[: rng.integers(len(text))],
    ]
    return choices[rng.integers(len(choices))]


def _same(a, b) -> bool:
    if [name for name, _ in a] != [name for name, _ in b]:
        return False
    return all(np.allclose(x, y, rtol=1e-6, atol=1e-6) for (_, x), (_, y) in zip(a, b, strict=True))


def _check(name: str, count: int, folder: Path) -> None:
    path, read = FORMATS[name](folder)
    text = path.read_bytes().decode().replace("\r\n", "\n")
    (truth, noted), rng = read(), np.random.default_rng(55)
    refused = 0
    for i in range(count):
        changed = harmless(text, rng, name) if i % 2 or name not in LOSSY else lossy(text, rng)
        path.write_text(changed, encoding="utf-8", newline="")
        try:
            found, notes = read()
        except (ValueError, struct.error):
            refused += 1
            continue
        lost = name == "lights.csv" and changed.count("\n") < text.count("\n")  # a row or more
        assert _same(found, truth) or notes != noted or lost, (i, changed)
    assert refused < 0.6 * count


@pytest.mark.parametrize("name", FORMATS)
def test_forty_changed_files(name: str, tmp_path: Path) -> None:
    _check(name, 40, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_a_thousand_changed_files(name: str, tmp_path: Path) -> None:
    _check(name, 1000, tmp_path)
