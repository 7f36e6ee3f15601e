"""The parameters of `extended_hair` and their values at a hit: constants, or tables of strands."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance.bsdf.absorption import of_melanin
from appearance.bsdf.lobes import Fibre
from appearance.bsdf.shading_frame import ShadingFrame, axis_in_frame
from appearance.bsdf.strand_coordinates import NAMES, place_in_segment
from reconstruction.array_backend import for_kernels

INFINITE = float("inf")
SCALARS = {
    "longitudinal_roughness": (0.3, 0.001, 1.0),
    "azimuthal_roughness": (0.3, 0.001, 1.0),
    "scale_tilt": (2.0, -20.0, 20.0),
    "eta": (1.55 / 1.000277, 1.0001, 5.0),
}
"""Name: default, least and greatest value."""
MITSUBAS_SEGMENTS = 1 << 20
"""Number of segments above which Mitsuba's tangents are those of a place a tenth of a segment off:
it derives a hit's segment from one float32 coordinate."""
BROWN = of_melanin(1.3, 0.2)


class HairParameters:
    """The values of one BSDF, each a Dr.Jit array that Mitsuba's `traverse` may replace in place.

    `values` maps names to constants (`Float`, `Color3f`), per-strand `Float (S,)`, or tensors; what
    they mean is in `appearance.bsdf.plugin`. Raises `ValueError` naming the parameter.
    """

    def __init__(self, props: Any) -> None:
        self.values: dict[str, Any] = {}
        for name, limits in SCALARS.items():
            self.values[name] = _scalar(props, name, *limits)
        if "int_ior" in props or "ext_ior" in props:
            if "eta" in props:
                raise ValueError("extended_hair: give eta or int_ior and ext_ior, not both")
            ratio = _index(props, "int_ior", 1.55) / _index(props, "ext_ior", 1.000277)
            self.values["eta"] = _checked("int_ior/ext_ior", ratio, *SCALARS["eta"][1:])
        self.values["sigma_a"] = _absorption(props.get("sigma_a", BROWN))
        if "rotation" in props:
            self.values["rotation"] = _tensor("rotation", props["rotation"], 2, -np.pi, np.pi)
        self.strands = {name: props[name] for name in NAMES if name in props}
        self.refresh()
        missing = sorted(set(NAMES) - set(self.strands))
        tables = [n for n, v in self.values.items() if _cells(v) > 1 or n == "rotation"]
        if missing and tables:
            raise ValueError(
                f"extended_hair: {tables} belong to strands, which needs {missing}: "
                "merge strand_parameters(...) into the dictionary"
            )

    def refresh(self) -> None:
        """Look for tables that are constant: those are read without a lookup."""
        tables: list[str] = [n for n in ("sigma_a", "rotation") if n in self.values]
        self._constant = {name: _constant(self.values[name]) for name in tables}
        turn = self._constant.get("rotation", [])
        self._turns = turn is None or any(x[0] != 0 for x in turn)

    def fibre(self, place: StrandHit) -> Fibre:
        """The fibre at a hit."""
        return Fibre(
            self._look_up("sigma_a", mi.Color3f, place),
            place.scalar(self.values["longitudinal_roughness"]),
            place.scalar(self.values["azimuthal_roughness"]),
            place.scalar(self.values["eta"]),
            -dr.deg2rad(place.scalar(self.values["scale_tilt"])),
        )

    def frame(self, place: StrandHit) -> ShadingFrame:
        """The fibre's frame at a hit: its own direction, and the corrective of its cell."""
        straight = self.straight(place)
        if not self._turns and not dr.grad_enabled(self.values.get("rotation")):
            return straight
        turn = self._look_up("rotation", mi.Vector2f, place)
        normal = straight.enter(place.si.to_local(place.normal))
        axis = mi.Vector3f(*axis_in_frame(turn.x, turn.y, normal.x, normal.z))
        return ShadingFrame(straight.tangent, axis)

    def straight(self, place: StrandHit) -> ShadingFrame:
        """The fibre's frame at a hit without its corrective."""
        return ShadingFrame(place.tangent if self._many_segments() else None, None)

    def _many_segments(self) -> bool:
        """Whether the curves have more segments than Mitsuba finds a frame for."""
        indices = self.strands.get("segment_indices")
        return indices is not None and len(indices) > MITSUBAS_SEGMENTS

    def _look_up(self, name: str, kind: Any, place: StrandHit) -> Any:
        value = self.values[name]
        if not dr.is_tensor_v(value):
            return value
        if _cells(value) == 1:
            return dr.gather(kind, value.array, mi.UInt32(0))
        constant = self._constant[name]
        if constant is None or dr.grad_enabled(value):  # a gradient belongs to its cell
            return place.cell(value, kind)
        return kind(constant)


class StrandHit:
    """The place of a hit, computed only as far as it is used."""

    def __init__(self, strands: dict[str, Any], si: Any, active: Any) -> None:
        self.strands, self.si, self.active = strands, si, active

    @cached_property
    def strand(self) -> Any:
        """Index of the strand."""
        return self._gather("UInt32", "strand_of_segment", self.si.prim_index)

    @cached_property
    def along(self) -> Any:
        """0 at the root to 1 at the tip, in segments."""
        first = self._gather("UInt32", "first_segment", self.strand)
        end = self._gather("UInt32", "first_segment", self.strand + 1)
        inside, _ = self._in_segment
        whole = mi.Float(self.si.prim_index - first)
        return dr.minimum((whole + inside) / mi.Float(end - first), 1)

    @cached_property
    def tangent(self) -> tuple[Any, Any]:
        """The fibre's direction at the hit, in the plane of the shading frame's x and y."""
        along = self.si.to_local(mi.Vector3f(self._in_segment[1]))
        length = dr.rsqrt(along.x * along.x + along.y * along.y + 1e-30)
        return along.x * length, along.y * length

    @cached_property
    def _in_segment(self) -> tuple[Any, Any]:
        return place_in_segment(
            mi.Vector3f(self.si.p),
            self.strands["control_points"],
            self._gather("UInt32", "segment_indices", self.si.prim_index),
            self.active,
        )

    @cached_property
    def normal(self) -> Any:
        """The first of the strand's own two normals."""
        return self._gather("Vector3f", "reference_normals", self.si.prim_index)

    def scalar(self, value: Any) -> Any:
        """The element of a constant or per-strand `Float`."""
        if dr.width(value) == 1:
            return value
        return dr.gather(mi.Float, value, self.strand, self.active)

    def cell(self, table: Any, kind: Any) -> Any:
        """The value of a table at the hit: nearest on the scalp, linear along the strand."""
        if table.ndim == 2:
            return dr.gather(kind, table.array, self.strand, self.active)
        layers, columns, rows, _ = table.shape
        uv = self._gather("Point2f", "root_uv", self.strand)
        column = dr.minimum(mi.UInt32(uv.x * columns), columns - 1)
        cell = column * rows + dr.minimum(mi.UInt32(uv.y * rows), rows - 1)
        if layers == 1:
            return dr.gather(kind, table.array, cell, self.active)
        height = self.along * (layers - 1)
        below = dr.minimum(mi.UInt32(height), layers - 2)
        index = below * (columns * rows) + cell
        low = dr.gather(kind, table.array, index, self.active)
        high = dr.gather(kind, table.array, index + columns * rows, self.active)
        return dr.lerp(low, high, height - mi.Float(below))

    def _gather(self, kind: str, name: str, index: Any) -> Any:
        return dr.gather(getattr(mi, kind), self.strands[name], index, self.active)


def _absorption(value: Any) -> Any:
    if isinstance(value, mi.TensorXf):
        return _tensor("sigma_a", value, 3, 0.0, INFINITE)
    channels = [value] * 3 if isinstance(value, float) else value
    if len(channels) != 3:
        raise ValueError(f"extended_hair: sigma_a must be an rgb colour, got {value}")
    return mi.Color3f(*(_checked("sigma_a", v, 0.0, INFINITE) for v in channels))


def _scalar(props: Any, name: str, default: float, low: float, high: float) -> Any:
    return _checked(name, props.get(name, default), low, high)


def _checked(name: str, value: Any, low: float, high: float) -> Any:
    """`value` as an opaque `Float`, after a check of its range."""
    numbers = np.atleast_1d(np.asarray(getattr(value, "array", value), np.float32))
    in_range = (numbers >= np.float32(low)) & (numbers <= np.float32(high))
    if not (in_range & np.isfinite(numbers)).all():
        raise ValueError(
            f"extended_hair: {name} must be finite and in [{low:g}, {high:g}], "
            f"got {numbers.min():g} to {numbers.max():g}"
        )
    if len(numbers) == 1:
        # not NumPy's memory: kernels are compiled anew for each alignment
        return dr.opaque(mi.Float, float(numbers[0]))
    return mi.Float(for_kernels(numbers))


def _tensor(name: str, value: Any, channels: int, low: float, high: float) -> Any:
    shape: Sequence[int] = value.shape
    if len(shape) not in (2, 4) or shape[-1] != channels or 0 in shape:
        raise ValueError(
            f"extended_hair: {name} must be a tensor (S, {channels}) or (n_c, w, h, {channels}), "
            f"got {tuple(shape)}"
        )
    _checked(name, value, low, high)
    return value


def _index(props: Any, name: str, default: float) -> float:
    value = props.get(name, default)
    return float(mi.lookup_ior(props, name, default) if isinstance(value, str) else value)


def _cells(value: Any) -> int:
    """Number of entries of a constant, a per-strand array or a table."""
    return int(np.prod(value.shape[:-1])) if dr.is_tensor_v(value) else int(dr.width(value))


def _constant(table: Any) -> list[Any] | None:
    """The channels of a table that is the same everywhere; None where it varies."""
    if not dr.is_tensor_v(table) or dr.grad_enabled(table):
        return None
    channels = table.shape[-1]
    lane = dr.arange(mi.UInt32, len(table.array))
    first = dr.gather(mi.Float, table.array, lane % channels)
    if not dr.all(table.array == first):
        return None
    return [dr.opaque(mi.Float, table.array[i]) for i in range(channels)]
