"""USD `BasisCurves` through `usd-core`.

Written are linear curves with `curveVertexCounts`, `points`, `widths` (twice the radius) and, if
known, the primvar `confidence` per point, z up, in metres. Read are all linear `BasisCurves` of a
stage, except those with purpose "guide", in the world frame, converted to z up and metres.
Cubic curves are refused: their control points are not on the hair.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, Vt

from reconstruction.arrays import Array, Floats, Ints
from reconstruction.files.durable import writing
from reconstruction.files.strands.errors import StrandFileError
from reconstruction.geometry.strands import Strands

_START = Usd.TimeCode.EarliestTime()
"""The first time sample, or the only value: many programs write time samples only."""
_Y_UP_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def read_usd(path: Path) -> Strands:
    """Read all linear `BasisCurves` of a stage, metres, z up, at the start of an animation."""
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
    if not found:
        raise StrandFileError("no BasisCurves in this stage")
    points, counts, radius = (np.concatenate(part) for part in zip(*found, strict=True))
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    if len(radius) == 0:
        return Strands(points, offsets)
    same = bool((radius == radius[0]).all())
    return Strands(points, offsets, float(radius[0]) if same else radius)


def _curves(prim: Any, cache: Any, turn: Array) -> tuple[Floats, Ints, Floats]:
    """Points in metres, vertex counts and per-point radii of one prim."""
    curves = UsdGeom.BasisCurves(prim)
    where = prim.GetPath()
    if curves.GetTypeAttr().Get() != UsdGeom.Tokens.linear:
        raise StrandFileError(f"{where}: only linear curves are supported; convert cubic ones")
    if curves.GetWrapAttr().Get() == UsdGeom.Tokens.periodic:
        raise StrandFileError(f"{where}: closed (periodic) curves are not strands")
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
    widths = np.asarray(curves.GetWidthsAttr().Get(_START) or [], np.float64) * scale
    if len(widths) == 0:
        widths = np.full(len(points), 8e-5)
    elif len(widths) == 1:
        widths = np.repeat(widths, len(points))
    elif len(widths) == len(counts) and len(counts) != len(points):
        widths = np.repeat(widths, counts)
    elif len(widths) != len(points):
        raise StrandFileError(
            f"{where}: {len(widths)} widths for {len(counts)} curves with {len(points)} points"
        )
    thin = int((~(widths > 0)).sum())
    if thin:
        raise StrandFileError(
            f"{where}: {thin} of {len(widths)} widths are not above 0: give strands a width at all "
            "points"
        )
    return world.astype(np.float32), counts, (widths / 2).astype(np.float32)


def write_usd(path: Path, strands: Strands) -> None:
    """Write one linear `BasisCurves` prim, `/hair`, the stage's default prim."""
    stage = new_stage(UsdGeom.Tokens.z)
    stage.SetDefaultPrim(define_curves(stage, "/hair", strands).GetPrim())
    save_stage(stage, path)


def new_stage(up: Any) -> Any:
    """An empty stage in metres with up axis `up`, "Y" or "Z"."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
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
