"""What the photometric methods are asked for."""

from __future__ import annotations

from dataclasses import dataclass

from reconstruction.growth.surface_strands import SurfaceOptions
from reconstruction.images.orientation import LogGaborBank
from reconstruction.light_codes.extension import ExtensionOptions
from reconstruction.light_codes.search import SearchOptions

# Frozen, so that all options may share them.
_BANK = LogGaborBank(count=48, spread=1.0, wavelength=5.0)
_SEARCH, _EXTENSION = SearchOptions(), ExtensionOptions()
_STRANDS = SurfaceOptions(apart=6e-4, step=0.7, shortest=5.0, smooth=2.0)


@dataclass(frozen=True)
class LightCodeOptions:
    """Options of line stereo and of what strings its segments together.

    `volume_grid` metres are the voxels in which depths are bounded, at most `deepest` metres behind
    where a ray enters the hair's volume. Segments count that at least `least_views` views found
    alike, their own and two others, within `support_distance` metres and `support_angle_deg`.
    Lines are averaged in cells of `crowd` metres before `strands` are traced through them.
    Segments count `field_weight` times their confidence in an orientation field that both feed.
    """

    bank: LogGaborBank = _BANK
    volume_grid: float = 4e-3
    deepest: float = 0.06
    least_views: int = 3
    support_distance: float = 1.5e-3
    support_angle_deg: float = 15.0
    crowd: float = 3e-4
    field_weight: float = 4.0
    search: SearchOptions = _SEARCH
    strands: SurfaceOptions = _STRANDS
    extension: ExtensionOptions = _EXTENSION


DEFAULTS = LightCodeOptions()
