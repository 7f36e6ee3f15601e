"""Alembic `.abc` curves, as output, through the extra `alembic` (alembic3d, PyAlembic's wheels).

Not as input: the library checks that a file is whole, but three in a hundred files with a few
damaged bytes end the process instead of raising. Alembic knows neither axes nor unit; by custom y
is up, and one unit is written a metre.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reconstruction.files.durable import writing
from reconstruction.files.strands.errors import StrandFileError
from reconstruction.geometry.strands import Strands

_Z_UP_TO_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def write_abc(path: Path, strands: Strands) -> None:
    """Write one set of linear curves, `/hair`, y up; widths are twice the radius.

    Raises `StrandFileError` where the extra is not installed.
    """
    try:
        import imath
        from alembic3d import Abc, AbcGeom
    except ImportError as error:
        raise StrandFileError(
            f"{path}: .abc is written by alembic3d, which is not installed ({error}): "
            "pip install 'hairstage[alembic]'"
        ) from error
    turned = strands.transformed(_Z_UP_TO_Y_UP, np.zeros(3))
    vary = isinstance(strands.radius, np.ndarray)
    width = 2 * np.atleast_1d(np.asarray(strands.radius, np.float32))
    scope = AbcGeom.GeometryScope.kVertexScope if vary else AbcGeom.GeometryScope.kConstantScope
    # A sample only points at its arrays: the names keep them alive until it is written.
    points = imath.V3fArrayFromBuffer(turned.points)
    counts = imath.IntArrayFromBuffer(np.diff(strands.offsets).astype(np.int32))
    widths = imath.FloatArrayFromBuffer(width)
    kind = AbcGeom.CurveType.kLinear, AbcGeom.CurvePeriodicity.kNonPeriodic
    width_sample = AbcGeom.OFloatGeomParamSample(widths, scope)
    sample = AbcGeom.OCurvesSchemaSample(points, counts, *kind, width_sample)
    try:
        with writing(path) as temporary:
            archive = Abc.OArchive(str(temporary))
            curves = AbcGeom.OCurves(archive.getTop(), "hair")
            curves.getSchema().set(sample)
            del curves, archive  # the file is complete when the last of these is gone
    except RuntimeError as error:
        raise StrandFileError(f"{path}: cannot be written ({error})") from error
