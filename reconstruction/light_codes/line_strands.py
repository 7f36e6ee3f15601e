"""Strands from line stereo alone, and its part in the fusion with light planes."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import Array
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_queries import surface_samples
from reconstruction.light_codes.measure_segments import connect_segments, measure_segments
from reconstruction.light_codes.segments import Segments
from reconstruction.masks import MaskedCapture
from reconstruction.reconstruct_options import LightCodeOptions
from reconstruction.report.report import Progress, Report, silent
from reconstruction.tangents.estimate import Measured

SEGMENT_WEIGHT = 4.0
"""Of a segment's confidence, in an orientation field that it shares with measured tangents."""


def line_strands(
    masked: MaskedCapture,
    head: Mesh | None,
    report: Report,
    *,
    method: Literal["photometric", "lmvs"] = "photometric",
    options: LightCodeOptions = LightCodeOptions(),
    progress: Progress = silent,
) -> tuple[list[Array], Segments]:
    """Polylines `(N, 3)` from line stereo, the end that is nearer to the head first.

    Without a head it is the higher end. None of them is rooted. Also the segments that they come
    from. Raises `CaptureError` as `measure_segments` does.
    """
    views, segments = measure_segments(
        masked, head, report, method=method, options=options, progress=progress
    )
    return _roots_first(connect_segments(views, segments, report), head), segments


def merge(measured: Measured, segments: Segments) -> Measured:
    """The measurements of both methods; segments count `SEGMENT_WEIGHT` times their confidence."""
    return Measured(
        np.concatenate([measured.points, segments.points]),
        np.concatenate([measured.directions, segments.directions]),
        np.concatenate([measured.confidence, SEGMENT_WEIGHT * segments.confidence]),
    )


def _roots_first(polylines: list[Array], head: Mesh | None) -> list[Array]:
    if not polylines:
        return []
    ends = np.stack([[p[0] for p in polylines], [p[-1] for p in polylines]], axis=1)
    if head is None:
        far = -ends[:, :, 2]
    else:
        samples, _, _ = surface_samples(head, 2e-3)
        far = cKDTree(samples).query(ends)[0]
    return [p if a <= b else p[::-1] for p, (a, b) in zip(polylines, far, strict=True)]
