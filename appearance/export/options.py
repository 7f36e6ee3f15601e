"""Options of an export, in a module without Mitsuba: the command line checks them without it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from reconstruction.options import Count, options


@options
class ExportOptions:
    """What becomes of the strands on their way out.

    `strands`: so many of them, drawn at random, their radius larger by as much as the length lost,
    which keeps the area that they cover; all where None or where there are fewer. `guides`: strands
    that stand for clumps of the others, 0 for none. `cards`: ribbons of the finest level of glTF;
    each further level has a quarter of them. The most make a texture of 16,384 pixels, what
    graphics cards take.
    """

    strands: Count | None = None
    guides: Annotated[int, Field(ge=0)] = 0
    cards: Annotated[int, Field(gt=0, le=4096)] = 600
    seed: Annotated[int, Field(ge=0)] = 0
