"""The options of `reconstruct`; lengths in metres. Without NumPy, for a service to check them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from reconstruction.deprecated import with_new_names
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
    """How the motion is solved, and continued `between` two tracking frames."""

    method: Literal["direct", "registered"] = "direct"
    between: Literal["interpolate", "hold"] = "interpolate"


@options
class MeasureOptions:
    """How tangents are measured; lengths in metres, None: derived from the capture.

    The filter `bank` is applied to images under groups of neighbouring lights; `texture_scale` in
    pixels is that of their local mean. Points closer than `thin` are merged first (None: 1.25
    pixels, or as far as 250,000 points are apart). Points up to `tolerance` behind a camera's depth
    are visible in it (None: 5/3 pixels). Scores of a point's directions are averaged over up to
    `neighbours` within `radius`; those of reflections under single lights count `reflection_weight`
    times those of the texture, those of the lines in which a sweep's points lie `line_weight`
    times. None: the radius and weights by which half of the cameras predicts the other half best.
    """

    bank: LogGaborBank = LogGaborBank(wavelength=4.0, count=24, spread=1.5)
    texture_scale: Length = 2.6
    radius: Length | None = None
    neighbours: Count = 96
    thin: Length | None = None
    reflection_weight: Factor | None = None
    line_weight: Factor | None = None
    tolerance: Length | None = None


@options
class SearchOptions:
    """How line stereo searches depths.

    `step` metres between depths, at most 5/3 of a pixel's width. Segments are compared in up to
    `neighbours` nearest visible views. The `candidates` best depths of each pixel by few points are
    compared at all points of a segment; 0 compares all depths (brute force). Every `lattice`th
    pixel both ways is searched first, the others within the depths around them; 1 searches all
    pixels alike.
    """

    step: Length = 5e-4
    neighbours: Annotated[int, Field(ge=1, le=31)] = 16  # with the reference their bits fill a word
    candidates: Annotated[int, Field(ge=0)] = 4
    lattice: Count = 4


@options
class LightCodeOptions:
    """Options of line stereo (the methods `photometric`, `lmvs` and, in part, `fused`).

    Segments need the agreement of `least_views` views, their own included.
    """

    bank: LogGaborBank = LogGaborBank(wavelength=5.0, count=48, spread=1.0)
    least_views: Count = 3
    search: SearchOptions = SearchOptions()


@options
class RefineOptions:
    """How strands are refined jointly after growth, in `steps` of Gauss-Newton.

    Strands that add less than `marginal_coverage` per cell along them are removed; a measured line
    of full confidence covers 1 of a cell (1 mm wide, or 0.8 of the distance between measured points
    if that is less), a guess 0.05. 0 keeps every strand.
    """

    steps: Annotated[int, Field(ge=0, le=20)] = 3
    marginal_coverage: Annotated[float, Field(ge=0, le=1)] = 0.03

    @model_validator(mode="before")
    @classmethod
    def _new_names(cls, values: Any) -> Any:
        return with_new_names("refine", values) if isinstance(values, dict) else values


@options
class ReconstructOptions:
    """Options of a reconstruction.

    `held_out` cameras are not used. `grid` is the voxels' edge (None: 5/3 pixels, 1 to 2 mm);
    `roots` strands are grown from the scalp, then gaps are filled. `max_length` is the hair's.
    `margin` is the envelope's extent in front of the visible surface (None: 1.1 pixels).
    `scalp_points` is a file of digitised scalp points to fit a head to, `head_mesh` (OBJ) the head
    to fit instead of the generic one. Gaps are filled `within` metres of a measurement (None: 3 mm
    or two voxels, on a hull 12 mm); give more for wider pixels.
    What no camera sees is filled with copies of the strands to `hidden_density` metres of hair in a
    cubic centimetre (None: as the depths of a sweep's points show; 0: not at all).
    `radius` of the strands; None covers as much as a head of hair, less where strands are dense.
    `frame` is that of the written strands and head: of the user's cameras, for an imported capture,
    or the stage's.
    """

    held_out: tuple[str, ...] = ()
    grid: Length | None = None
    roots: Annotated[int, Field(ge=1, le=1_000_000)] = 8000
    max_length: Length = 0.3
    margin: Factor | None = None
    scalp_points: str | None = None
    head_mesh: str | None = None
    within: Length | None = None
    hidden_density: Factor | None = None
    radius: Length | None = None
    frame: Literal["user", "stage"] = "user"
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    motion: MotionOptions = MotionOptions()
    measure: MeasureOptions = MeasureOptions()
    light_codes: LightCodeOptions = LightCodeOptions()
    refine: RefineOptions = RefineOptions()
