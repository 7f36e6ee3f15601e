"""USD `BasisCurves` through `usd-core`.

Written are linear curves with `curveVertexCounts`, `points`, `widths` (twice the radius) and, if
known, the primvar `confidence` per point, z up, in metres. Read are all `BasisCurves` of a stage,
except those with purpose "guide", in the world frame, converted to z up and metres; cubic ones as
polylines on the curve.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, Vt

from reconstruction.arrays import Array, Floats, Ints
from reconstruction.files.durable import writing
from reconstruction.files.strands.curves import TO_BEZIER, on_curve, segment_counts
from reconstruction.files.strands.errors import StrandFileError, radii
from reconstruction.geometry.strands import Strands
from reconstruction.geometry.world_frame import WorldFrame

_START = Usd.TimeCode.EarliestTime()
"""The first time sample, or the only value: many programs write time samples only."""
_Y_UP_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def read_usd(path: Path) -> Strands:
    """Read all `BasisCurves` of a stage, metres, z up, at the start of an animation."""
    try:
        return _read(Usd.Stage.Open(str(path)))
    except Tf.ErrorException as error:  # also of values, which are read lazily
        raise StrandFileError(f"cannot be read as USD ({_first_line(error)})") from error


def _read(stage: Any) -> Strands:
    turn = float(UsdGeom.GetStageMetersPerUnit(stage)) * np.eye(3)
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y:
        turn = _Y_UP_TO_Z_UP @ turn
    cache = UsdGeom.XformCache(_START)
    prims = stage.Traverse(Usd.TraverseInstanceProxies())  # includes instances
    curves = (UsdGeom.BasisCurves(prim) for prim in prims)
    hair = (c.GetPrim() for c in curves if c and c.ComputePurpose() != UsdGeom.Tokens.guide)
    found = [_curves(prim, cache, turn) for prim in hair]
    others = (UsdGeom.NurbsCurves, UsdGeom.HermiteCurves)
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        if any(prim.IsA(kind) for kind in others):
            raise StrandFileError(
                f"{prim.GetPath()}: {prim.GetTypeName()} are not read: convert them to BasisCurves"
            )
    if not found:
        raise StrandFileError("no BasisCurves in this stage")
    points, counts, widths = (np.concatenate(part) for part in zip(*found, strict=True))
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    radius = radii(widths)
    return Strands(points, offsets) if radius is None else Strands(points, offsets, radius)


def _curves(prim: Any, cache: Any, turn: Array) -> tuple[Floats, Ints, Array]:
    """Points in metres, vertex counts and widths of the points of one prim."""
    curves = UsdGeom.BasisCurves(prim)
    where = prim.GetPath()
    kind, basis, wrap = (
        attribute.Get()
        for attribute in (curves.GetTypeAttr(), curves.GetBasisAttr(), curves.GetWrapAttr())
    )
    if wrap == UsdGeom.Tokens.periodic:
        raise StrandFileError(f"{where}: closed (periodic) curves are not strands")
    basis = "linear" if kind == UsdGeom.Tokens.linear else basis
    known = kind in ("linear", "cubic") and wrap in ("nonperiodic", "pinned")
    if not known or basis not in ("linear", *TO_BEZIER):
        raise StrandFileError(f"{where}: {kind} curves of basis {basis}, {wrap}, are not read")
    points = np.asarray(curves.GetPointsAttr().Get(_START) or [], np.float64).reshape(-1, 3)
    counts = np.asarray(curves.GetCurveVertexCountsAttr().Get(_START) or [], np.int64)
    if (counts < 2).any() or counts.sum() != len(points):
        raise StrandFileError(
            f"{where}: curveVertexCounts must be at least 2 and sum to the {len(points)} points, "
            f"they sum to {counts.sum()}"
        )
    to_world = np.asarray(cache.GetLocalToWorldTransform(prim))  # row vectors: p' = p @ M
    linear = to_world[:3, :3] @ turn.T
    world = points @ linear + to_world[3, :3] @ turn.T
    scale = abs(np.linalg.det(linear)) ** (1 / 3)
    widths, interpolation = _widths(curves)
    if not (np.isfinite(widths) & (widths >= 0)).all():
        raise StrandFileError(f"{where}: widths must be 0 or more, got {widths.min():g}")
    widths = widths * scale
    if len(widths) == 0:
        widths, interpolation = np.array([8e-5]), UsdGeom.Tokens.constant
    segments = segment_counts(basis, counts, wrap == "pinned")
    if segments is None:
        raise StrandFileError(
            f"{where}: cubic {basis} curves of {int(counts.min())} to {int(counts.max())} points "
            "do not end at a segment's end"
        )
    sizes = {"constant": 1, "vertex": len(points), "varying": int((segments + 1).sum())}
    sizes["uniform"] = len(counts)
    if sizes.get(str(interpolation)) != len(widths):  # its default contradicts the widths
        interpolation = next((name for name in sizes if sizes[name] == len(widths)), None)
    if interpolation is None:
        raise StrandFileError(
            f"{where}: {len(widths)} widths for {len(counts)} curves with {len(points)} points"
        )
    if interpolation in ("constant", "uniform"):
        widths = np.repeat(widths, len(points) if len(widths) == 1 else counts)
    if basis != "linear":
        varying = interpolation == "varying"
        world, counts, widths = on_curve(basis, world, counts, widths, wrap == "pinned", varying)
    return world.astype(np.float32), counts, np.maximum(widths, 0)


def _widths(curves: Any) -> tuple[Array, str | None]:
    """Widths and their interpolation; the primvar comes before the attribute (UsdGeomCurves)."""
    primvar = UsdGeom.PrimvarsAPI(curves).GetPrimvar("widths")
    if primvar and primvar.HasValue():
        values, interpolation = primvar.ComputeFlattened(_START), primvar.GetInterpolation()
    else:
        values, interpolation = curves.GetWidthsAttr().Get(_START), curves.GetWidthsInterpolation()
    return np.asarray(values or [], np.float64), str(interpolation)


def write_usd(path: Path, strands: Strands, frame: WorldFrame | None = None) -> None:
    """Write one linear `BasisCurves` prim, `/hair`, the stage's default prim.

    The strands are in metres with z up, or in the unit and axes of `frame`.
    """
    stage = new_stage(frame or WorldFrame())
    stage.SetDefaultPrim(define_curves(stage, "/hair", strands).GetPrim())
    save_stage(stage, path)


def new_stage(frame: WorldFrame) -> Any:
    """An empty stage with the unit and up axis of `frame`; z for an axis that USD cannot state."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, frame.usd_up.upper())
    UsdGeom.SetStageMetersPerUnit(stage, frame.unit)
    return stage


def define_curves(stage: Any, where: str, strands: Strands) -> Any:
    """Linear `BasisCurves` at the path `where`, with widths and extent."""
    curves = UsdGeom.BasisCurves.Define(stage, where)
    curves.CreateTypeAttr(UsdGeom.Tokens.linear)
    curves.CreateWrapAttr(UsdGeom.Tokens.nonperiodic)
    curves.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(strands.points))
    counts = np.diff(strands.offsets).astype(np.int32)
    curves.CreateCurveVertexCountsAttr(Vt.IntArray.FromNumpy(counts))
    width = 2 * np.atleast_1d(np.asarray(strands.radius, np.float32))
    curves.CreateWidthsAttr(Vt.FloatArray.FromNumpy(width))
    vary = isinstance(strands.radius, np.ndarray)
    curves.SetWidthsInterpolation(UsdGeom.Tokens.vertex if vary else UsdGeom.Tokens.constant)
    if strands.confidence is not None:
        primvars = UsdGeom.PrimvarsAPI(curves)
        confidence = primvars.CreatePrimvar(
            "confidence", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex
        )
        confidence.Set(Vt.FloatArray.FromNumpy(strands.confidence))
    if len(strands):
        reach = width.max() / 2
        low, high = strands.points.min(axis=0) - reach, strands.points.max(axis=0) + reach
        corners = [Gf.Vec3f(*map(float, corner)) for corner in (low, high)]
        curves.CreateExtentAttr(Vt.Vec3fArray(corners))
    return curves


def save_stage(stage: Any, path: Path) -> None:
    """Write a stage atomically. Raises `StrandFileError`."""
    try:
        with writing(path) as temporary:
            stage.GetRootLayer().Export(str(temporary))
    except Tf.ErrorException as error:
        raise StrandFileError(f"{path}: cannot be written ({_first_line(error)})") from error


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__
