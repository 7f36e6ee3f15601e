"""Colour of a file's values: transfer curves, primaries, ICC profiles, coding points."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from reconstruction.arrays import Array

Curve = Literal["linear", "srgb"] | float | Callable[[Any], Any]
"""Values with white at 1 to linear light: sRGB, the exponent of a power, or a function."""

Numbers = Sequence[float] | Array

REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""x and y of red, green, blue and white."""
_REC2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
_P3_D65 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
_D50 = np.array([0.9642, 1.0, 0.8249])
"""XYZ of the white of ICC profiles (ICC.1:2022, 6.3.4.3)."""
_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)
_SAME = 2e-3
"""Difference of a matrix from the identity that is rounding."""


@dataclass(frozen=True)
class Colour:
    """`curve` of the values, None: not in the file; `matrix (3, 3)` from linear RGB to Rec. 709,
    None: is Rec. 709."""

    curve: Curve | None = None
    matrix: Array | None = None


def rgb_to_xyz(chromaticities: Numbers) -> Array:
    """Matrix `(3, 3)` with luminance 1 for white. Raises `ValueError` for no primaries."""
    xy = np.asarray(chromaticities, float).reshape(-1, 2)
    if xy.shape != (4, 2) or not np.isfinite(xy).all() or (xy[3] <= 0).any():
        raise ValueError(f"chromaticities {_numbers(chromaticities)} are no primaries and white")
    columns = np.column_stack([xy, 1 - xy.sum(axis=1)]).T
    if abs(np.linalg.det(columns[:, :3])) < 1e-6:
        raise ValueError(f"chromaticities {_numbers(chromaticities)} span no colours")
    return np.asarray(columns[:, :3] * np.linalg.solve(columns[:, :3], columns[:, 3] / xy[3, 1]))


def to_rec709(chromaticities: Numbers) -> Array | None:
    """Matrix from linear RGB of `chromaticities` to Rec. 709; white stays white (Bradford), as
    OpenEXR's `AcesInputFile` converts. None if nothing changes."""
    matrix = rgb_to_xyz(chromaticities)
    target = rgb_to_xyz(REC709)
    adapted = _adaptation(matrix.sum(axis=1), target.sum(axis=1)) @ matrix
    return _unless_same(np.linalg.solve(target, adapted))


def xyz_to_rec709() -> Array:
    """Matrix from CIE XYZ, without adaptation."""
    return np.asarray(np.linalg.inv(rgb_to_xyz(REC709)))


def parametric(
    g: float, a: float = 1, b: float = 0, c: float = 0, d: float = -np.inf, e: float = 0,
    f: float = 0,
) -> Callable[[Any], Any]:  # fmt: skip
    """(a x + b)^g + e from d on, c x + f below (ICC.1:2022, 10.18); odd below 0."""

    def curve(values: Any) -> Any:
        x = np.abs(values)
        light = np.where(x >= d, np.maximum(a * x + b, 0) ** g + e, c * x + f)
        return np.asarray(np.sign(values) * light, np.float32)

    return curve


SRGB = parametric(2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
"""IEC 61966-2-1."""
_BT709 = parametric(1 / 0.45, 1 / 1.099, 0.099 / 1.099, 1 / 4.5, 0.081)


def decoded(share: Any, curve: Curve) -> Any:
    """Linear light of values with white at 1; odd below 0."""
    if curve == "linear" or curve == 1.0:
        return share
    if curve == "srgb":
        return SRGB(share)
    return curve(share) if callable(curve) else parametric(float(curve))(share)


def of_code_points(primaries: int, transfer: int) -> Colour:
    """Colour by the numbers of ITU-T H.273, as in PNG's cICP and AVIF's nclx."""
    curves: dict[int, Curve | None] = {
        **dict.fromkeys((1, 6, 14, 15), _BT709), 2: None, 4: 2.2, 5: 2.8, 8: "linear", 13: "srgb",
    }  # fmt: skip
    spaces = {1: REC709, 2: REC709, 9: _REC2020, 12: _P3_D65}
    if transfer not in curves or primaries not in spaces:
        names = {16: " (PQ)", 18: " (HLG)"}
        raise ValueError(
            f"colour primaries {primaries} with transfer {transfer}{names.get(transfer, '')} are "
            "not read: convert to linear Rec. 709"
        )
    return Colour(curves[transfer], to_rec709(spaces[primaries]))


def of_icc(profile: bytes) -> Colour:
    """Colour of an ICC profile of curves and primaries. Raises `ValueError` for tables."""
    data: dict[bytes, bytes] = {}
    try:
        (count,) = struct.unpack_from(">I", profile, 128)
        for i in range(min(count, 100)):
            tag, at, size = struct.unpack_from(">4sII", profile, 132 + 12 * i)
            data[tag] = profile[at : at + size]
        if profile[16:20] == b"GRAY":
            return Colour(_icc_curve(data[b"kTRC"]))
        curves = [_icc_curve(data[c + b"TRC"]) for c in (b"r", b"g", b"b")]
        columns = [struct.unpack_from(">3i", data[c + b"XYZ"], 8) for c in (b"r", b"g", b"b")]
    except (LookupError, struct.error):
        text = data.get(b"desc", b"")[12:90].decode("latin-1")
        name = "".join(c for c in text if c.isascii() and c.isprintable())
        raise ValueError(
            f"ICC profile {name!r} has no curves and primaries: convert to sRGB"
        ) from None
    target = rgb_to_xyz(REC709)
    rec709 = _adaptation(target.sum(axis=1), _D50) @ target
    matrix = np.linalg.solve(rec709, np.array(columns, float).T / 65536)
    if not np.allclose(matrix.sum(axis=1), 1, atol=0.05):
        raise ValueError("ICC profile: red, green and blue are not white together")

    def curve(values: Any) -> Any:
        if np.ndim(values) < 3:  # one value for all channels
            return np.min([c(values) for c in curves], axis=0)
        return np.stack([c(values[..., k]) for k, c in enumerate(curves)], axis=-1)

    return Colour(curve, _unless_same(matrix))


def _icc_curve(data: bytes) -> Callable[[Any], Any]:
    """`curveType` or `parametricCurveType`."""
    if data[:4] == b"para":
        kind = struct.unpack_from(">H", data, 8)[0]
        count = (1, 3, 4, 5, 7)[kind]
        g, *rest = (n / 65536 for n in struct.unpack_from(f">{count}i", data, 12))
        a, b, *rest = rest or (1.0, 0.0)
        if kind in (1, 2):  # constant below -b/a
            above = rest[0] if kind == 2 else 0.0
            return parametric(g, a, b, 0, -b / a, above, above)
        return parametric(g, a, b, *rest)
    if data[:4] != b"curv":
        raise KeyError
    count = struct.unpack_from(">I", data, 8)[0]
    table = struct.unpack_from(f">{count}H", data, 12) if count < 1 << 17 else ()
    if count < 2:
        return parametric(table[0] / 256 if table else 1.0)
    x, y = np.linspace(0, 1, count), np.array(table) / 65535
    return lambda values: np.asarray(np.interp(values, x, y), np.float32)


def _adaptation(white: Array, target: Array) -> Array:
    """Bradford: XYZ under `white` to XYZ under `target`."""
    gain = (_BRADFORD @ target) / (_BRADFORD @ white)
    return np.asarray(np.linalg.solve(_BRADFORD, gain[:, None] * _BRADFORD))


def _unless_same(matrix: Any) -> Array | None:
    return None if np.allclose(matrix, np.eye(3), atol=_SAME) else np.asarray(matrix)


def _numbers(values: Numbers) -> str:
    return ", ".join(f"{float(v):g}" for v in values)
