"""Writing Alembic `.abc` curves with the extra `alembic` (alembic3d, PyAlembic's wheels).

Reading is not supported: damaged files can abort the process. Alembic has neither axes nor unit; by
custom y is up, and one unit is a metre.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.files.durable import require_free, writing
from reconstruction.files.strands.errors import StrandFileError
from reconstruction.geometry.strands import Strands

_Z_UP_TO_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def write_abc(path: Path, strands: Strands, *, turned: bool = True) -> None:
    """Write one set of linear curves, `/hair`; widths are twice the radius.

    `turned` converts z up to y up. Raises `StrandFileError` if the extra is not installed.
    """
    if turned:
        strands = strands.transformed(_Z_UP_TO_Y_UP, np.zeros(3))
    write_archive(path, 20 * len(strands.points), lambda top: add_curves(top, "hair", strands))


def write_archive(path: Path, needed: int, fill: Callable[[Any], Any]) -> None:
    """Write an archive atomically; `fill` adds objects to its top object.

    `fill` must not keep references: the library completes the file when all objects are freed.
    Raises `StrandFileError` if the extra is missing or writing fails, and `DiskFull` without room
    for `needed` bytes, since the library aborts the process on a full disk.
    """
    try:
        import imath  # noqa: F401
        from alembic3d import Abc
    except ImportError as error:
        raise StrandFileError(
            f"{path}: .abc is written by alembic3d, which is not installed ({error}): "
            "pip install 'hairstage[alembic]'"
        ) from error
    require_free(path, needed, reserve=0)
    try:
        with writing(path) as temporary:
            fill(Abc.OArchive(str(temporary)).getTop())
    except RuntimeError as error:
        raise StrandFileError(f"{path}: cannot be written ({error})") from error


def add_curves(top: Any, name: str, strands: Strands) -> Any:
    """Add linear curves with a width at each point; returns them, for `add_values`.

    Blender needs the basis "none", or it makes Bézier curves, and a width per point.
    """
    import imath
    from alembic3d import AbcGeom

    # a sample references its arrays: these names keep them alive until it is written
    points = imath.V3fArrayFromBuffer(strands.points)
    counts = imath.IntArrayFromBuffer(np.diff(strands.offsets).astype(np.int32))
    width = 2 * np.asarray(strands.radius, np.float32)
    widths = imath.FloatArrayFromBuffer(np.full(len(strands.points), width, np.float32))
    curves = AbcGeom.OCurves(top, name)
    curves.getSchema().set(
        AbcGeom.OCurvesSchemaSample(
            points,
            counts,
            AbcGeom.CurveType.kLinear,
            AbcGeom.CurvePeriodicity.kNonPeriodic,
            AbcGeom.OFloatGeomParamSample(widths, AbcGeom.GeometryScope.kVertexScope),
            AbcGeom.OV2fGeomParamSample(),
            AbcGeom.ON3fGeomParamSample(),
            AbcGeom.BasisType.kNoBasis,
        )
    )
    return curves


def add_values(curves: Any, name: str, values: NDArray[Any] | str, scope: str) -> None:
    """Add a geometry parameter of `scope` "constant", "uniform" (a strand) or "vertex" (a point).

    `values` are text, int16, int32, float32 `(M,)` or float32 `(M, 2 or 3)`.
    """
    import imath
    from alembic3d import AbcGeom

    if isinstance(values, str):
        kind, array = "String", imath.StringArray(1)
        array[0] = values
    elif values.dtype == np.int16:
        kind, array = "Int16", imath.ShortArray(len(values))
        for i, value in enumerate(values.tolist()):
            array[i] = value
    else:
        form = {"i": "Int", "f": "Float"}[values.dtype.kind]
        if values.ndim == 2:
            form = f"V{values.shape[1]}f"
        kind = "Int32" if form == "Int" else form
        array = getattr(imath, f"{form}ArrayFromBuffer")(np.ascontiguousarray(values))
    where = getattr(AbcGeom.GeometryScope, f"k{scope.capitalize()}Scope")
    parameters = curves.getSchema().getArbGeomParams()
    parameter = getattr(AbcGeom, f"O{kind}GeomParam")(parameters, name, False, where, 1)
    parameter.set(getattr(AbcGeom, f"O{kind}GeomParamSample")(array, where))
