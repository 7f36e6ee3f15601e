"""Options of an export, in a module without Mitsuba: the command line checks them without it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from reconstruction.options import Count, options


@options
class ExportOptions:
    """Options of an export.

    `strands`: their number, of a random subset or with more strands between those of the model,
    with radii that keep the covered area; all of the model's if None.
    `guides`: number of guide strands. `cards`: ribbons of the finest level of glTF; each further
    level has a quarter of them. The most make a texture of 16,384 pixels, the limit of graphics
    cards.
    """

    strands: Count | None = None
    guides: Annotated[int, Field(ge=0)] = 0
    cards: Annotated[int, Field(gt=0, le=4096)] = 600
    seed: Annotated[int, Field(ge=0)] = 0
