"""How a field is fitted; light, so that a service checks options without Mitsuba."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from reconstruction.options import Count, options

Kind = Literal["turns", "modulation", "additive", "whole"]
"""What a field is of: a factor on inverse rendering's light and turns of its fibres, harmonics of
such a factor, of what is added to it, or of all light."""
Degree = Annotated[int, Field(ge=0, le=3)]
Positive = Annotated[float, Field(gt=0)]


def _both_or_none(level: tuple[int, int, int]) -> tuple[int, int, int]:
    if (level[1] == 0) != (level[2] == 0):
        raise ValueError(f"a level is (n_c, w, h) or (n_c, 0, 0), got {level}")
    return level


Level = Annotated[
    tuple[Count, Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]],
    AfterValidator(_both_or_none),
]

RIDGES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 10.0)
NESTED: tuple[Level, ...] = ((2, 4, 4), (4, 12, 12), (8, 32, 32))
OF_TURNS: tuple[Level, ...] = ((4, 4, 4), (8, 10, 10), (12, 24, 24))


@options
class FieldOptions:
    """How a field of reflectance is fitted.

    `kind`: "turns" multiplies the light of inverse rendering by a factor of each place, and by what
    two turns of the fibre do to lobes of the longitudinal roughness `beta_m` (a capture's fit takes
    the model's), the ridge of the factor `stiffness` times that of turns, as left-out pictures
    prefer; "modulation" multiplies the light of inverse rendering by 1 + m, m in the strands'
    frames; "additive" (GroomLight §3.3) adds to it, in the world's frame; "whole" is all of the
    light, without inverse rendering (GaussianHair's appearance, as GroomLight's supplement has it).
    `degree` of the harmonics of the direction to the camera and to the light. `levels`: grids of
    anchors (n_c along strands, w, h cells of the scalp's map) whose values add up, from coarse to
    fine; w = h = 0 are anchors on every strand. `ridges` are tried from the last to the first,
    and grow with the degrees a and b of a coefficient as (1 + a(a + 1))(1 + b(b + 1)). `iterations`
    of conjugate gradients at most, fewer once the gradient has fallen to `tolerance`. Views and
    lights are parted into `folds` each, and left out part by part to choose the ridge and judge.
    """

    kind: Kind = "modulation"
    beta_m: Annotated[float, Field(gt=0, le=1)] = 0.3
    stiffness: Annotated[tuple[Positive, ...], Field(min_length=1)] = (10.0, 0.1)
    degree: Degree = 1
    levels: Annotated[tuple[Level, ...], Field(min_length=1)] | None = None
    ridges: Annotated[tuple[Positive, ...], Field(min_length=1)] = RIDGES
    iterations: Count = 40
    tolerance: Annotated[float, Field(gt=0)] = 0.01
    folds: Annotated[int, Field(ge=2, le=16)] = 3

    @property
    def grids(self) -> tuple[Level, ...]:
        """`levels`, or what the kind has."""
        return self.levels or (OF_TURNS if self.kind == "turns" else NESTED)

    @property
    def multiplies(self) -> bool:
        """Whether the field is a factor on inverse rendering's light."""
        return self.kind in ("turns", "modulation")


@options
class FieldRequest:
    """What a job may ask for.

    Of the training lights `lights` and of each camera's hair `pixels` are used, all where there are
    fewer. `hits` rays a pixel say which strands it shows; pictures of inverse rendering have `spp`
    paths a pixel of at most `max_depth` vertices. "none" fits no field, "best" turns and
    a modulation, of which the one stays whose left-out pictures gain more.
    """

    field: Literal["none", "best", "turns", "modulation", "additive"] = "modulation"
    lights: Count = 64
    pixels: Count = 20_000
    hits: Annotated[int, Field(ge=1, le=64)] = 8
    spp: Count = 36
    max_depth: Count = 16
    fit: FieldOptions = FieldOptions()
