"""The subject: a procedural one by name, or a strand file."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from appearance import HairAppearance
from reconstruction import Camera, Mesh, Rig, Strands, read_obj, read_strands
from reconstruction.arrays import Array
from reconstruction.files.strands import READABLE
from reconstruction.head.generic import generic_head
from simulators.subject.clothing import Dressed, dressed
from simulators.subject.colouring import mixed_absorption
from simulators.subject.grooms import BEARD, GROOMS, covering_radius, grow

MIXED = "-mixed"
"""End of the name of a groom whose strands have several colours."""
DRESSED = "dressed"
"""The subject `wavy` with a beard, clothes and a hand."""
NAMES = (*GROOMS, *(name + MIXED for name in GROOMS), DRESSED)

_APPEARANCE = {
    "wavy": HairAppearance((0.12, 0.24, 0.50), 0.28, 0.30),
    "straight": HairAppearance((0.30, 0.52, 0.95), 0.20, 0.28),
    "curly": HairAppearance((0.20, 0.42, 0.80), 0.34, 0.36),
    "coils": HairAppearance((0.90, 1.40, 2.20), 0.30, 0.32),
}
_FILE_APPEARANCE = HairAppearance((0.10, 0.20, 0.45), 0.3, 0.3)
_SKIN = {
    "wavy": (0.45, 0.31, 0.25),
    "straight": (0.52, 0.38, 0.31),
    "curly": (0.28, 0.18, 0.13),
    "coils": (0.17, 0.10, 0.07),
}
_FILE_SKIN = (0.42, 0.30, 0.24)


class SubjectError(ValueError):
    """A subject that does not fit this stage; the message has the reason and what to do."""


@dataclass(frozen=True, eq=False)
class Subject:
    """Hair on a head, in the world frame of the rig at pose 0.

    `head` may be None for a hairpiece; `skin` is its diffuse albedo per linear RGB channel.
    `absorption (n_c, S, 3)`, from root to tip, is that of every strand; None: that of `hair`, which
    is its mean otherwise. The last `beard` strands grow on the face. `dressed` is what is rendered
    in place of `head` and `skin`.
    """

    name: str
    strands: Strands
    head: Mesh | None
    hair: HairAppearance
    skin: tuple[float, float, float]
    absorption: Array | None = None
    beard: int = 0
    dressed: Dressed | None = None


def make_subject(name: str, seed: int = 0, strands: int | None = None) -> Subject:
    """The procedural subject `name` of `NAMES`; `strands` overrides their number.

    The seed moves every strand; a groom has the same strands in one colour and `MIXED`. Raises
    `SubjectError` for another name.
    """
    if name not in NAMES:
        raise SubjectError(
            f"unknown subject {name!r}: choose one of {', '.join(NAMES)}, or give a strand file "
            f"({', '.join(READABLE)})"
        )
    if name == DRESSED:
        return _dressed(make_subject("wavy", seed, strands), seed)
    groom, head = name.removesuffix(MIXED), generic_head()
    # the seed depends on the name, so that the grooms differ in every strand
    draw = int(np.random.SeedSequence([seed, *groom.encode()]).generate_state(1)[0])
    hair = grow(GROOMS[groom], head, draw, strands)
    subject = Subject(name, hair, head, _APPEARANCE[groom], _SKIN[groom])
    if name == groom:
        return subject
    absorption = mixed_absorption(hair, draw)
    red, green, blue = (float(x) for x in absorption.mean(axis=(0, 1)))
    mean = replace(subject.hair, sigma_a=(red, green, blue))
    return replace(subject, hair=mean, absorption=absorption)


def _dressed(bare: Subject, seed: int) -> Subject:
    """The subject with a full beard, which its scalp then includes, and clothes."""
    assert bare.head is not None
    middle = bare.head.vertices[bare.head.faces].mean(axis=1)
    x, y, z = np.abs(middle[:, 0]), middle[:, 1], middle[:, 2]
    lips = (x < 0.026) & (z < -0.052) & (z > -0.077) & (y < -0.08)
    cheeks = (z < -0.036 - 0.25 * np.maximum(0.03 - x, 0)) & (y < 0.0) & (z > -0.125)
    beard = cheeks & ~lips & ~((z > -0.042) & (x < 0.028))
    count = round(BEARD.strands * len(bare.strands) / GROOMS["wavy"].strands)
    face = Mesh(bare.head.vertices, bare.head.faces, beard)
    hairs = grow(BEARD, face, seed, count)
    points = np.concatenate([bare.strands.points, hairs.points])
    offsets = np.concatenate([bare.strands.offsets, bare.strands.offsets[-1] + hairs.offsets[1:]])
    head = replace(face, scalp=beard | bare.head.scalp)
    strands = Strands(points, offsets, bare.strands.radius)
    worn = dressed(head, bare.skin)
    return replace(bare, name=DRESSED, strands=strands, head=head, beard=count, dressed=worn)


def load_subject(
    name_or_file: str,
    head: str | Path | None = None,
    *,
    seed: int = 0,
    say: Callable[[str], None] = lambda line: print(line, file=sys.stderr),
) -> Subject:
    """A procedural subject by name, or the strands of a file on the OBJ `head`.

    If the strands of a file cover less than half of 100,000 fibres of 40 µm radius, they get the
    radius with that coverage, and `say` gets a line about it. Raises `SubjectError`, or
    `ValueError` of the reader.
    """
    path = Path(name_or_file)
    if name_or_file in NAMES:
        if head is not None:
            raise SubjectError(f"the subject {name_or_file!r} has its own head: leave out {head}")
        return make_subject(name_or_file, seed)
    if not path.is_file():
        raise SubjectError(
            f"unknown subject {name_or_file!r}: expected a file or one of {', '.join(NAMES)}"
        )
    strands = read_strands(path)
    if len(strands) == 0:
        raise SubjectError(f"{path}: no strands")
    wanted = covering_radius(len(strands))
    given = _mean_radius(strands)
    if given < 0.5 * wanted:
        say(
            f"{path.name}: {len(strands)} strands of {given * 1e3:.3f} mm radius cover less than a "
            f"head of hair; rendered with {wanted * 1e3:.2f} mm, which keeps the coverage of "
            "100,000 fibres of 0.040 mm"
        )
        strands = replace(strands, radius=wanted)
    mesh = read_obj(head) if head is not None else None
    return Subject(path.stem, strands, mesh, _FILE_APPEARANCE, _FILE_SKIN)


def _mean_radius(strands: Strands) -> float:
    """The mean over strands, metres, whatever the number of their points."""
    radius = np.broadcast_to(np.asarray(strands.radius, float), len(strands.points))
    return float((np.add.reduceat(radius, strands.offsets[:-1]) / np.diff(strands.offsets)).mean())


def check_fits(subject: Subject, rig: Rig) -> None:
    """Raise `SubjectError` unless each camera has half of the hair in view or is half filled by
    it."""
    points = subject.strands.points.astype(float)
    for camera in rig.cameras:
        pixels, depth = camera.project(points)
        on = camera.inside(pixels) & (depth > 0.05)
        share = float(np.mean(on))
        if share < 0.5 and _filled(camera, pixels[on]) < 0.5:
            low, high = points.min(axis=0).round(3), points.max(axis=0).round(3)
            raise SubjectError(
                f"subject {subject.name}: only {share:.0%} of the hair is in the view of "
                f"{camera.name} of rig {rig.name}; it spans {low} to {high} m; the stage expects "
                "metres, z up, face "
                "towards −y, the head's centre at the origin: convert the file"
            )


def _filled(camera: Camera, pixels: Array) -> float:
    """Share of the image's 16x16 tiles that `pixels (N, 2)` fall into."""
    tiles = (pixels + 0.5) * 16 / [camera.width, camera.height]
    return len(np.unique(tiles.astype(int) @ [1, 16])) / 256
