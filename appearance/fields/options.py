"""Options of a field's fit, without Mitsuba, for a service to check them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from reconstruction.options import Count, options

Kind = Literal["modulation", "additive", "whole"]
"""A factor on inverse rendering's light, light added to it, or all light."""
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


@options
class FieldOptions:
    """How a field of reflectance is fitted.

    `kind`: "modulation" multiplies the light of inverse rendering by 1 + m, m in the strands'
    frames; "additive" (GroomLight §3.3) adds to it, in the world's frame; "whole" replaces it
    (GaussianHair's appearance, as in GroomLight's supplement). `degree` of the harmonics of the
    directions to camera and light. `levels`: grids of anchors (n_c along strands, w, h cells of the
    scalp's map) that add up, from coarse to fine; w = h = 0 are anchors on every strand. `ridges`
    are tried from the last to the first, times (1 + a(a + 1))(1 + b(b + 1)) for the degrees a and b
    of a coefficient. At most `iterations` of conjugate gradients, until the relative gradient is
    `tolerance`. Views and lights are split into `folds` each for cross-validation.
    """

    kind: Kind = "modulation"
    degree: Degree = 1
    levels: Annotated[tuple[Level, ...], Field(min_length=1)] = NESTED
    ridges: Annotated[tuple[Positive, ...], Field(min_length=1)] = RIDGES
    iterations: Count = 40
    tolerance: Annotated[float, Field(gt=0)] = 0.01
    folds: Annotated[int, Field(ge=2, le=16)] = 3

    @property
    def multiplies(self) -> bool:
        """Whether the field is a modulation."""
        return self.kind == "modulation"


@options
class FieldRequest:
    """The options of a job.

    At most `lights` training lights and `pixels` of each camera's hair are used, `hits` rays a
    pixel to find strands, and `spp` paths a pixel of at most `max_depth` vertices to render; None
    is derived (`resolved`). "none" fits no field and removes an earlier one.
    """

    field: Literal["none", "modulation", "additive"] = "modulation"
    lights: Count | None = None
    pixels: Count | None = None
    hits: Annotated[int, Field(ge=1, le=64)] = 8
    spp: Count = 16
    max_depth: Count = 16
    fit: FieldOptions = FieldOptions()

    def resolved(self, cameras: int, strands: int) -> tuple[int, int]:
        """`lights`, and `pixels` of each of `cameras`, with numbers for None.

        A fold leaves out twice as many lights as there are harmonics of their directions: enough to
        judge a field by. All cameras together have as many pixels at each of the finest anchors as
        there are harmonics of the direction to a camera.
        """
        layers, columns, rows = self.fit.levels[-1]
        anchors, harmonics = layers * (columns * rows or strands), (self.fit.degree + 1) ** 2
        pixels = -(-harmonics * anchors // max(cameras, 1))
        return self.lights or 2 * self.fit.folds * harmonics, self.pixels or pixels
