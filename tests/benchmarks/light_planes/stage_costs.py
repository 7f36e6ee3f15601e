"""How the light-plane stages grow with cameras, lines, voxels and strands, and what follows."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from reconstruction import Capture
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.growth.field import OrientationField, solve_field
from reconstruction.growth.from_roots import Tracing, grow_from_roots
from reconstruction.head.scalp import Scalp, sample_roots
from reconstruction.light_planes import sweep_peaks, triangulate
from reconstruction.report.report import peak_memory
from reconstruction.tangents.estimate import Measured


@dataclass(frozen=True)
class Growth:
    """Seconds (and the process's peak memory, GB) of a stage at several sizes of one quantity.

    `exponent` is the slope of log seconds over log size, by least squares.
    """

    stage: str
    over: str
    sizes: tuple[int, ...]
    seconds: tuple[float, ...]
    peak_gb: tuple[float | None, ...]

    @property
    def exponent(self) -> float:
        """How the time grows: 1 is in proportion."""
        slope, _ = np.polyfit(np.log(self.sizes), np.log(self.seconds), 1)
        return float(slope)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return {**vars(self), "exponent": self.exponent}


def measure_growth(
    stage: str, over: str, sizes: Sequence[int], work: Callable[[int], object]
) -> Growth:
    """Run `work` at each size, once."""
    seconds, peaks = [], []
    for size in sizes:
        begin = time.perf_counter()
        with peak_memory() as peak:
            work(size)
        seconds.append(time.perf_counter() - begin)
        peaks.append(peak.gb)
    return Growth(stage, over, tuple(sizes), tuple(seconds), tuple(peaks))


def of_triangulation(capture: Capture) -> list[Growth]:
    """Reading sweeps and triangulating, over cameras (all projectors) and over lines (two cameras).

    Lines grow by leaving projectors out.
    """
    rig = capture.rig
    lines = np.cumsum([p.height for p in rig.projectors])

    def shrunk(cameras: int, projectors: int) -> None:
        part = capture.view(cameras=[c.name for c in rig.cameras[:cameras]])
        part.rig = replace(part.rig, projectors=rig.projectors[:projectors])
        triangulate(part, peaks=sweep_peaks(part), hull=False)

    counts = [n for n in (1, 2, 4, 8, 16) if n <= len(rig.cameras)]
    return [
        measure_growth(
            "triangulation", "cameras", counts, lambda n: shrunk(n, len(rig.projectors))
        ),
        measure_growth(
            "triangulation",
            "lines",
            [int(n) for n in lines],
            lambda n: shrunk(min(2, len(rig.cameras)), int(np.searchsorted(lines, n)) + 1),
        ),
    ]


def of_field(
    envelope: VoxelGrid, measured: Measured, spacings: Sequence[float] = (4e-3, 3e-3, 2e-3, 1.5e-3)
) -> Growth:
    """Solving the field over its voxels: the same envelope at several spacings."""
    grids = {int(g.inside.sum()): g for g in (regridded(envelope, s) for s in spacings)}

    def solve(voxels: int) -> None:
        solve_field(
            grids[voxels],
            measured.points,
            measured.directions,
            measured.confidence,
        )

    return measure_growth("field", "voxels", sorted(grids), solve)


def of_strands(field: OrientationField, scalp: Scalp, max_length: float) -> Growth:
    """Growing strands from the scalp over their number."""

    def grow(count: int) -> None:
        roots, normals = sample_roots(scalp, count, 0)
        grow_from_roots(field, roots, normals, Tracing(max_length=max_length))

    return measure_growth("growth", "strands", (2000, 8000, 32000), grow)


def regridded(grid: VoxelGrid, spacing: float) -> VoxelGrid:
    """The volume of `grid` on voxels of another `spacing`, metres; its corners stay."""
    low = grid.origin - grid.spacing / 2
    shape = np.ceil(grid.spacing * np.array(grid.inside.shape) / spacing).astype(int)
    empty = replace(grid, origin=low + spacing / 2, spacing=spacing, inside=np.ones(shape, bool))
    return replace(empty, inside=grid.contains(empty.centers()).reshape(empty.inside.shape))
