"""Everything that `reconstruct` can be asked for; lengths in metres.

Pure data, checked where it arrives, without what a method needs to run: a service shows and checks
options without loading NumPy.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from reconstruction.options import options

Length = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1)]
Factor = Annotated[float, Field(ge=0)]


@options
class LogGaborBank:
    """A bank of log-Gabor filters (see `images.orientation`).

    `wavelength` λ in pixels, `count` filters over half a turn, `spread` σ_φ in units of 180°/count.
    """

    wavelength: Annotated[float, Field(ge=2)] = 3.0
    count: Annotated[int, Field(ge=4)] = 128
    spread: Length = 2.0


@options
class MotionOptions:
    """How the motion is solved, and what the subject does `between` two tracking frames."""

    method: Literal["direct", "registered"] = "direct"
    between: Literal["interpolate", "hold"] = "interpolate"


@options
class MeasureOptions:
    """How tangents are measured.

    The `bank` answers to pictures under groups of neighbouring lights. Scores of a point's
    directions are averaged over up to `neighbours` within `radius`; where reflections under single
    lights are read too, which tell more, within `reflection_radius`, theirs `reflection_weight`
    times those of the texture. Points closer than `thin` are merged first. `tolerance` is how far
    behind a camera's own depth a point may lie and still count as seen.
    """

    bank: LogGaborBank = LogGaborBank(wavelength=6.0, count=24, spread=1.0)
    texture_scale: Length = 5.0
    radius: Length = 10e-3
    reflection_radius: Length = 4e-3
    neighbours: Count = 48
    thin: Length = 2e-3
    reflection_weight: Factor = 6.0
    tolerance: Length = 4e-3


@options
class SearchOptions:
    """How line stereo searches depths.

    `step` metres between depths, and 5/3 of a pixel's width at most. Segments are compared in up to
    `neighbours` nearest visible views. The `candidates` best depths of each pixel by few points go
    on to all of a segment's; 0 gives them all depths (brute force). The first stage takes every
    `coarse`th depth; the second also those between a candidate and the next. Every `lattice`th
    pixel both ways is searched first, the others near what was found around them; 1 searches all of
    them alike.
    """

    step: Length = 5e-4
    neighbours: Annotated[int, Field(ge=1, le=31)] = 16  # with the reference their bits fill a word
    candidates: Annotated[int, Field(ge=0)] = 4
    coarse: Count = 1
    lattice: Count = 4


@options
class LightCodeOptions:
    """Options of line stereo (the methods `photometric`, `lmvs` and, in part, `fused`).

    Segments count that at least `least_views` views found alike, their own and two others.
    """

    bank: LogGaborBank = LogGaborBank(wavelength=5.0, count=48, spread=1.0)
    least_views: Count = 3
    search: SearchOptions = SearchOptions()


@options
class RefineOptions:
    """How all strands are refined together after growth, in `steps` of Gauss-Newton.

    A strand stays that adds at least `worth` a millimetre to what the others explain, where 1 is a
    measured line of full confidence and a guessed millimetre counts 0.05; 0 keeps every strand.
    """

    steps: Annotated[int, Field(ge=0, le=20)] = 3
    worth: Annotated[float, Field(ge=0, le=1)] = 0.03


@options
class ReconstructOptions:
    """What the reconstruction is asked for.

    `held_out` cameras take no part at all. `grid` is the voxels' edge; `roots` strands are grown
    from the scalp, then gaps are filled. `max_length` is the hair's, which the user knows. `margin`
    is how far in front of the seen surface the envelope reaches. `scalp_points` is a file of
    digitised scalp points to fit a head to, where the capture has no `head.obj` or a better one is
    wanted, and `head_mesh` (OBJ) the head to fit instead of the generic one. Gaps are filled
    `within` metres of what was measured (None: 3 mm, or two voxels, of a hull 12 mm): give more
    where pixels are wider. `radius` of the strands; None takes the one that keeps a head of hair's
    coverage.
    """

    held_out: tuple[str, ...] = ()
    grid: Length = 2e-3
    roots: Annotated[int, Field(ge=1, le=1_000_000)] = 8000
    max_length: Length = 0.3
    margin: Factor = 2e-3
    scalp_points: str | None = None
    head_mesh: str | None = None
    within: Length | None = None
    radius: Length | None = None
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    motion: MotionOptions = MotionOptions()
    measure: MeasureOptions = MeasureOptions()
    light_codes: LightCodeOptions = LightCodeOptions()
    refine: RefineOptions = RefineOptions()
