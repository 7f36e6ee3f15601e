"""A program: the curves of an Alembic archive as `.npz`. It imports nothing of this package.

    python -P alembic_archive.py ARCHIVE OUT

Of curves k, the first sample: `points_k (N, 3)` in the archive's world, `counts_k (S,)`,
`widths_k (M,)`, and `kind_k`: type, basis, wrap, scope of the widths, and the object's name.
"""

from __future__ import annotations

import resource
import sys
from pathlib import Path
from typing import Any

import numpy as np

NOT_INSTALLED = 3
MEMORY = 2 << 30
"""Bytes beside 16 for each byte of the archive: a damaged one claims any number."""


def main(path: str, out: str) -> int:
    """Write the curves of `path` to `out`; returns the exit status."""
    try:
        import imath  # noqa: F401
        from alembic3d import Abc
    except ImportError:
        return NOT_INSTALLED
    most = MEMORY + 16 * Path(path).stat().st_size
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    found: dict[str, Any] = {}
    _add(Abc.IArchive(path).getTop(), np.eye(4), found)
    np.savez(out, allow_pickle=False, **found)
    return 0


def _add(parent: Any, to_world: Any, found: dict[str, Any]) -> None:
    """Add the curves below `parent`; `to_world (4, 4)` is for row vectors."""
    from alembic3d import AbcGeom

    for i in range(parent.getNumChildren()):
        header = parent.getChildHeader(i)
        child, matrix = parent.getChild(i), to_world
        if AbcGeom.IXform.matches(header):
            sample = AbcGeom.IXform(parent, header.getName()).getSchema().getValue()
            m = sample.getMatrix()
            own = np.array([[m[r][c] for c in range(4)] for r in range(4)])
            matrix = own @ to_world if sample.getInheritsXforms() else own
        elif AbcGeom.ICurves.matches(header):
            curves = AbcGeom.ICurves(parent, header.getName())
            if not _is_guide(curves):
                _curves(curves, matrix, found)
        _add(child, matrix, found)


def _is_guide(curves: Any) -> bool:
    """Whether it has `groom_guide` (Epic's "Alembic for Grooms Specification")."""
    from alembic3d import Abc

    properties = curves.getProperties()
    for name in (".geom", ".arbGeomParams"):  # one that is missing would end the process
        if name not in _names(properties):
            return False
        properties = Abc.ICompoundProperty(properties, name)
    return "groom_guide" in _names(properties)


def _names(properties: Any) -> list[str]:
    count = properties.getNumProperties()
    return [properties.getPropertyHeader(i).getName() for i in range(count)]


def _curves(curves: Any, to_world: Any, found: dict[str, Any]) -> None:
    schema, k = curves.getSchema(), len(found) // 4
    sample = schema.getValue()
    points = np.asarray(memoryview(sample.getPositions()), np.float64).reshape(-1, 3)
    widths, scope = np.zeros(0), "none"
    if schema.getWidthsParam().valid():
        values = schema.getWidthsParam().getExpandedValue()
        scale = abs(np.linalg.det(to_world[:3, :3])) ** (1 / 3)
        widths = scale * np.asarray(memoryview(values.getVals()), np.float64)
        scope = str(values.getScope())
    kinds = (sample.getType(), sample.getBasis(), sample.getWrap())
    found[f"points_{k}"] = points @ to_world[:3, :3] + to_world[3, :3]
    found[f"counts_{k}"] = np.asarray(memoryview(sample.getCurvesNumVertices()), np.int64)
    found[f"widths_{k}"] = widths
    found[f"kind_{k}"] = np.array([*map(str, kinds), scope, curves.getFullName()])


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
