"""Alembic `.abc` curves with the extra `alembic` (alembic3d, PyAlembic's wheels).

Files are read in a process of its own, as the library ends it at some damaged ones. Alembic has
neither axes nor unit; by custom y is up, and one unit is a metre.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Array, Ints
from reconstruction.containment import plain_file
from reconstruction.files.durable import require_free, writing
from reconstruction.files.numpy_files import ANY_SIZE, read_arrays
from reconstruction.files.strands import alembic_archive
from reconstruction.files.strands.curves import TO_BEZIER, on_curve, segment_counts
from reconstruction.files.strands.errors import StrandFileError, radii, require_finite
from reconstruction.geometry.strands import Strands

INSTALL = "which is not installed: pip install 'hairstage[alembic]'"
READING = 300.0
"""Seconds that reading may take."""
_Z_UP_TO_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def read_abc(path: Path) -> Strands:
    """Read all curves of an archive but guides, in its own axes and unit, at its first sample;
    cubic ones as polylines on the curve."""
    program = alembic_archive.__file__
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "curves.npz"
        command = [sys.executable, "-P", program, str(plain_file(path, ANY_SIZE)), str(out)]
        try:
            done = subprocess.run(command, capture_output=True, timeout=READING, check=False)
        except subprocess.TimeoutExpired as error:
            raise StrandFileError(f"reading did not end in {READING:g} s") from error
        if done.returncode == alembic_archive.NOT_INSTALLED:
            raise StrandFileError(f".abc is read by alembic3d, {INSTALL}")
        if done.returncode:
            lines = done.stderr.decode(errors="replace").strip().splitlines()
            reason = lines[-1] if lines else f"its library ended with {done.returncode}"
            raise StrandFileError(f"cannot be read as Alembic ({reason})")
        arrays = read_arrays(out)
    found = [_polylines(*(arrays[f"{n}_{k}"] for n in ("points", "counts", "widths", "kind")))
             for k in range(len(arrays) // 4)]  # fmt: skip
    if not found:
        raise StrandFileError("no curves in this archive")
    points, counts, widths = (np.concatenate(part) for part in zip(*found, strict=True))
    radius = radii(widths)
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    points = points.astype(np.float32)
    require_finite(points, range(len(points)))
    return Strands(points, offsets) if radius is None else Strands(points, offsets, radius)


def _polylines(
    points: Array, counts: Ints, widths: Array, kind: NDArray[Any]
) -> tuple[Array, Ints, Array]:
    """Points, counts and widths of the points, of curves of a kind of `alembic_archive`."""
    form, basis, wrap, scope, where = kind.tolist()
    if wrap != "kNonPeriodic":
        raise StrandFileError(f"{where}: closed (periodic) curves are not strands")
    bases = {"kBezierBasis": "bezier", "kBsplineBasis": "bspline", "kCatmullromBasis": "catmullRom"}
    basis = "linear" if form == "kLinear" else bases.get(basis, basis)
    if form not in ("kLinear", "kCubic") or basis not in ("linear", *TO_BEZIER):
        raise StrandFileError(f"{where}: {form} curves of {basis} are not read: make them linear")
    if (counts < 2).any() or counts.sum() != len(points):
        raise StrandFileError(
            f"{where}: curves of {counts.min(initial=0)} points and more, {counts.sum()} in all: "
            f"expected at least 2, and the {len(points)} points"
        )
    segments = segment_counts(basis, counts, False)
    if segments is None:
        raise StrandFileError(f"{where}: cubic {basis} curves do not end at a segment's end")
    if not len(widths):
        widths = np.zeros(1)
    varying = scope == "kVaryingScope" and basis != "linear"
    sizes: dict[int, int | Ints] = {1: len(points), len(counts): counts, len(points): 1}
    if varying:
        sizes = {int((segments + 1).sum()): 1}
    if len(widths) not in sizes:
        raise StrandFileError(
            f"{where}: {len(widths)} widths for {len(counts)} curves with {len(points)} points"
        )
    widths = np.repeat(widths, sizes[len(widths)])
    return (
        (points, counts, widths)
        if basis == "linear"
        else on_curve(basis, points, counts, widths, False, varying)
    )


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
        raise StrandFileError(f"{path}: .abc is written by alembic3d, {INSTALL}") from error
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
