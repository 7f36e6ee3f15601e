"""Reading PLY files: their elements of numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.containment import plain_file

_KINDS = {"i1": "char int8", "u1": "uchar uint8", "i2": "short int16", "u2": "ushort uint16"}
_KINDS |= {"i4": "int int32", "u4": "uint uint32", "f4": "float float32", "f8": "double float64"}
_KIND_OF = {name: kind for kind, names in _KINDS.items() for name in names.split()}
_ORDERS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}


def read_ply(path: Path) -> dict[str, dict[str, NDArray[Any]]]:
    """Columns `(N,)` by element and property; elements from the first with a list on are not read.

    Raises `ValueError` if the file has fewer numbers than its header states, or more after an
    element that is its last.
    """
    data = plain_file(path).read_bytes()
    head, end, body = data.partition(b"end_header")
    lines = [line.split() for line in head.decode("ascii").splitlines()]
    if not end or lines[:1] != [["ply"]]:
        raise ValueError("no PLY header")
    body = body.partition(b"\n")[2]
    form = next((line[1] for line in lines if line[:1] == ["format"]), "none")
    if form not in _ORDERS:
        raise ValueError(f"format {form!r}; expected one of {', '.join(_ORDERS)}")
    at = [i for i, line in enumerate(lines) if line[:1] == ["element"]]
    order, words = _ORDERS[form], body.split() if form == "ascii" else []
    out: dict[str, dict[str, NDArray[Any]]] = {}
    for start, stop in zip(at, [*at[1:], len(lines)], strict=True):
        name, count = lines[start][1], int(lines[start][2])
        properties = [line[1:] for line in lines[start:stop] if line[:1] == ["property"]]
        if any(p[0] not in _KIND_OF for p in properties):
            if name == "vertex":
                raise ValueError("a vertex has a property that is not a number")
            return out
        names = [p[-1] for p in properties]
        if order is None:
            taken, words = words[: count * len(names)], words[count * len(names) :]
            if len(taken) < count * len(names):
                raise ValueError(f"{len(taken)} numbers for {count} x {name} of {len(names)}")
            table = np.array(taken, np.float64).reshape(count, len(names))
            out[name] = dict(zip(names, table.T, strict=True))
            continue
        kinds = [(n, order + _KIND_OF[p[0]]) for n, p in zip(names, properties, strict=True)]
        kind = np.dtype(kinds)
        if count < 0 or len(body) < count * kind.itemsize:
            raise ValueError(f"{len(body)} bytes for {count} x {name} of {kind.itemsize}")
        rows = np.frombuffer(body, kind, count)
        body = body[count * kind.itemsize :]
        out[name] = {n: rows[n] for n in names}
    left = len(words) if order is None else len(body.strip())
    if left:
        raise ValueError(f"{left} {'numbers' if order is None else 'bytes'} belong to no element")
    return out
