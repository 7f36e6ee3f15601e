"""Curves of USD and Alembic: those of other programs, and ours as others read them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from scipy import interpolate
from scipy.spatial import cKDTree

from reconstruction import StrandFileError, Strands, read_strands, write_strands
from reconstruction.files import durable
from reconstruction.files.strands import alembic_archive
from reconstruction.files.strands.alembic import add_curves, add_values, write_archive

LINES = [np.array([[0, 0, 0], [0, 0, 0.01], [0, 0.01, 0.02]])]
LINES += [LINES[0][:2] + 0.1]


@pytest.fixture
def two() -> Strands:
    return Strands.from_list(LINES, radius=2e-4)


@pytest.mark.parametrize("vary", [False, True])
def test_alembic_curves_are_y_up(vary: bool, two: Strands, tmp_path: Path) -> None:
    pytest.importorskip("imath", reason="the extra 'alembic' is not installed")
    from alembic3d import Abc, AbcGeom

    radius = np.arange(1, 6, dtype=np.float32) * 1e-5 if vary else 2e-4
    path = tmp_path / "hair.abc"
    write_strands(path, Strands(two.points, two.offsets, radius))
    schema = AbcGeom.ICurves(Abc.IArchive(str(path)).getTop(), "hair").getSchema()
    sample = schema.getValue()
    assert sample.getType() == AbcGeom.CurveType.kLinear
    assert sample.getBasis() == AbcGeom.BasisType.kNoBasis  # what Blender goes by
    assert np.asarray(memoryview(sample.getCurvesNumVertices())).tolist() == [3, 2]
    points = np.asarray(memoryview(sample.getPositions()))
    np.testing.assert_array_equal(points, two.points[:, [0, 2, 1]] * np.float32([1, 1, -1]))
    widths = schema.getWidthsParam().getExpandedValue()
    np.testing.assert_allclose(list(widths.getVals()), np.full(5, 2 * radius), rtol=1e-6)
    assert widths.getScope() == AbcGeom.GeometryScope.kVertexScope


def test_usd_guides_are_not_read_as_hair(two: Strands, tmp_path: Path) -> None:
    write_strands(tmp_path / "hair.usda", two)
    stage = Usd.Stage.Open(str(tmp_path / "hair.usda"))
    UsdGeom.Imageable(stage.GetDefaultPrim()).CreatePurposeAttr("guide")
    stage.GetRootLayer().Save()
    with pytest.raises(StrandFileError, match="no BasisCurves"):
        read_strands(tmp_path / "hair.usda")


def test_alembic_that_is_not_installed_or_has_no_folder(
    two: Strands, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imath", None)
    with pytest.raises(StrandFileError, match=r"hair\.abc: .*pip install 'hairstage\[alembic\]'"):
        write_strands(tmp_path / "hair.abc", two)
    (tmp_path / "other.abc").write_bytes(b"Ogawa")
    without = subprocess.CompletedProcess([], alembic_archive.NOT_INSTALLED, b"", b"")
    monkeypatch.setattr(subprocess, "run", lambda *a, **k: without)
    with pytest.raises(StrandFileError, match=r"other\.abc: .*pip install 'hairstage\[alembic\]'"):
        read_strands(tmp_path / "other.abc")
    monkeypatch.undo()
    pytest.importorskip("imath", reason="the extra 'alembic' is not installed")
    with pytest.raises(StrandFileError, match=r"hair\.abc: cannot be written"):
        write_strands(tmp_path / "absent" / "hair.abc", two)
    write_strands(tmp_path / "bald.abc", Strands.from_list([]))
    assert len(read_strands(tmp_path / "bald.abc")) == 0


USDA = """#usda 1.0
(
    metersPerUnit = 0.01
    upAxis = "Y"
)
def Xform "head" {{
    double3 xformOp:translate = (0, 0, 5)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def BasisCurves "fringe" {{
        uniform token type = "{type}"
        int[] curveVertexCounts = [2]
        point3f[] points = [(1, 2, 3), (4, 5, 6)]
        float[] widths = {widths}
    }}
}}
"""


def test_usd_axes_units_and_transforms(tmp_path: Path) -> None:
    path = tmp_path / "x.usda"
    path.write_text(USDA.format(type="linear", widths="[0.02]"))
    strands = read_strands(path)
    np.testing.assert_allclose(
        strands.points, [[0.01, -0.08, 0.02], [0.04, -0.11, 0.05]], atol=1e-9
    )
    assert strands.radius == pytest.approx(1e-4)


def test_usd_instances_are_read_where_each_of_them_is(tmp_path: Path) -> None:
    """Assemblies reference a groom as "instanceable": its curves are in a prototype then."""
    (tmp_path / "groom.usda").write_text(USDA.format(type="linear", widths="[0.02]"))
    placed = """
def "{name}" (
    instanceable = true
    references = @./groom.usda@</head>
) {{
    double3 xformOp:translate = ({x}, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}}
"""
    text = '#usda 1.0\n(\nmetersPerUnit = 0.01\nupAxis = "Y"\n)\n'
    text += placed.format(name="left", x=0) + placed.format(name="right", x=100)
    (tmp_path / "two.usda").write_text(text)
    strands = read_strands(tmp_path / "two.usda")
    one = np.array([[0.01, -0.03, 0.02], [0.04, -0.06, 0.05]])
    both = np.concatenate([one, one + np.array([1, 0, 0])])
    np.testing.assert_allclose(strands.points, both, atol=1e-7)
    assert (len(strands), strands.radius) == (2, pytest.approx(1e-4))


def test_usd_of_an_animation_is_read_at_its_start(tmp_path: Path) -> None:
    """Animations hold the values of frames alone, and none by default."""
    path = tmp_path / "x.usda"
    text = USDA.format(type="linear", widths="[0.02]")
    timed = {
        "int[] curveVertexCounts = [2]": "{1: [2], 2: [2]}",
        "point3f[] points = [(1, 2, 3), (4, 5, 6)]": "{1: [(1, 2, 3), (4, 5, 6)], 2: [(0, 0, 0),"
        " (0, 0, 9)]}",
        "float[] widths = [0.02]": "{1: [0.02], 2: [0.5]}",
    }
    for still, moving in timed.items():
        text = text.replace(still, f"{still.split(' = ')[0]}.timeSamples = {moving}")
    path.write_text(text)
    strands = read_strands(path)
    np.testing.assert_allclose(
        strands.points, [[0.01, -0.08, 0.02], [0.04, -0.11, 0.05]], atol=1e-9
    )
    assert strands.radius == pytest.approx(1e-4)


@pytest.mark.parametrize(
    ("kind", "widths", "words"),
    [
        ("cubic", "[0.02]", "cubic bezier curves of 2 to 2 points do not end"),
        ("linear", "[0.02, 0.03, 0.04]", "3 widths for 1 curves"),
        ("linear", "[0.02, -1]", "widths must be 0 or more, got -1"),
    ],
)
def test_usd_that_cannot_be_read(kind: str, widths: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "x.usda"
    path.write_text(USDA.format(type=kind, widths=widths))
    with pytest.raises(StrandFileError, match=f"/head/fringe: {words}"):
        read_strands(path)


def test_alembic_is_whole_before_it_gets_its_name(tmp_path: Path, monkeypatch) -> None:
    """Ogawa's sixth byte is 255 in a file that is complete, 0 before."""
    pytest.importorskip("imath", reason="the extra 'alembic' is not installed")
    flushed: list[bytes] = []
    monkeypatch.setattr(durable, "flush", lambda part: flushed.append(part.read_bytes()))
    write_strands(tmp_path / "hair.abc", Strands.from_list([np.eye(3)]))
    assert flushed == [(tmp_path / "hair.abc").read_bytes()]
    assert flushed[0][:6] == b"Ogawa\xff"


ARC = np.stack([0.03 * np.cos(np.linspace(0, 2, 10)), 0.03 * np.sin(np.linspace(0, 2, 10)),
                np.linspace(0, 0.09, 10)], axis=1)  # fmt: skip


def write_curves(path: Path, kind: str, basis: str, wrap: str, widths, interpolation: str) -> None:
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    curves = UsdGeom.BasisCurves.Define(stage, "/root/hair")
    curves.CreateTypeAttr(kind)
    curves.CreateBasisAttr(basis)
    curves.CreateWrapAttr(wrap)
    curves.CreateCurveVertexCountsAttr([10, 10])
    curves.CreatePointsAttr(np.vstack([ARC, ARC + 0.1]).astype(np.float32))
    if widths is not None:
        curves.CreateWidthsAttr(np.asarray(widths, np.float32))
        curves.SetWidthsInterpolation(interpolation)
    stage.GetRootLayer().Export(str(path))


def scipys_curve(basis: str, wrap: str):
    """SciPy's curve through or by `ARC`, as a function of [0, 1]: knots by the basis."""
    if basis == "bspline":
        points = ARC
        if wrap == "pinned":
            points = np.vstack([2 * ARC[0] - ARC[1], ARC, 2 * ARC[-1] - ARC[-2]])
        n = len(points)
        spline = interpolate.BSpline(np.arange(n + 4) - 3.0, points, 3)
        return lambda t: spline(t * (n - 3))
    if basis == "bezier":
        pieces = [interpolate.BPoly(ARC[3 * k : 3 * k + 4, None], [k, k + 1]) for k in range(3)]
        return lambda t: np.array([pieces[min(int(3 * v), 2)](3 * v) for v in t])
    points = np.vstack([2 * ARC[0] - ARC[1], ARC, 2 * ARC[-1] - ARC[-2]])
    inner = points[1:-1] if wrap == "pinned" else ARC[1:-1]
    slopes = (points[2:] - points[:-2]) / 2 if wrap == "pinned" else (ARC[2:] - ARC[:-2]) / 2
    spline = interpolate.CubicHermiteSpline(np.arange(len(inner)), inner, slopes)
    return lambda t: spline(t * (len(inner) - 1))


@pytest.mark.parametrize("wrap", ["pinned", "nonperiodic"])
@pytest.mark.parametrize("basis", ["catmullRom", "bspline", "bezier"])
def test_cubic_curves_are_followed_from_end_to_end(basis: str, wrap: str, tmp_path: Path) -> None:
    write_curves(tmp_path / "h.usda", "cubic", basis, wrap, [8e-5], "constant")
    strands = read_strands(tmp_path / "h.usda")
    assert len(strands) == 2
    np.testing.assert_allclose(strands[1], strands[0] + 0.1, atol=1e-6)
    truth = scipys_curve(basis, wrap)(np.linspace(0, 1, 4001))
    np.testing.assert_allclose(strands[0][[0, -1]], truth[[0, -1]], atol=1e-7)
    assert cKDTree(truth).query(strands[0])[0].max() < 2e-5
    ours = Strands.from_list([strands[0]])
    middle = interpolate.interp1d(np.cumsum(np.r_[0, np.linalg.norm(np.diff(ours.points, axis=0),
                                  axis=1)]), ours.points, axis=0)  # fmt: skip
    dense = middle(np.linspace(0, ours.lengths()[0] * 0.999999, 4001))
    assert cKDTree(dense).query(truth)[0].max() < 3e-5


@pytest.mark.parametrize(
    ("kind", "wrap", "widths", "interpolation", "root", "tip"),
    [
        ("linear", "nonperiodic", [*range(9, -1, -1)] * 2, "vertex", 4.5, 1e-6),
        ("cubic", "pinned", [*range(9, -1, -1)] * 2, "vertex", 4.5, 1e-6),
        ("cubic", "nonperiodic", [*range(7, -1, -1)] * 2, "varying", 3.5, 1e-6),
        ("cubic", "pinned", [3, 5], "uniform", 1.5, 1.5),
        ("cubic", "pinned", [3], "vertex", 1.5, 1.5),  # the interpolation's default: it is one
        ("linear", "nonperiodic", [0] * 20, "vertex", 4e-5, 4e-5),
        ("linear", "nonperiodic", None, "", 4e-5, 4e-5),
    ],
)
def test_widths_of_usd(kind, wrap, widths, interpolation, root, tip, tmp_path: Path) -> None:
    write_curves(tmp_path / "h.usda", kind, "catmullRom", wrap, widths, interpolation)
    strands = read_strands(tmp_path / "h.usda")
    radius = np.broadcast_to(strands.radius, len(strands.points))
    np.testing.assert_allclose(radius[[0, strands.offsets[1] - 1]], [root, tip], rtol=1e-6)


@pytest.mark.parametrize(
    ("basis", "wrap", "widths", "words"),
    [
        ("bspline", "periodic", [1], "closed"),
        ("bspline", "pinned", [1, 2, 3], "3 widths for 2 curves"),
        ("bspline", "pinned", [-1], "widths must be 0 or more, got -1"),
    ],
)
def test_curves_of_usd_that_are_not_clear_are_refused(basis, wrap, widths, words, tmp_path) -> None:
    write_curves(tmp_path / "h.usda", "cubic", basis, wrap, widths, "vertex")
    with pytest.raises(StrandFileError, match=words):
        read_strands(tmp_path / "h.usda")
    stage = Usd.Stage.Open(str(tmp_path / "h.usda"))
    stage.GetPrimAtPath("/root/hair").GetAttribute("wrap").Set("pinned")
    stage.GetPrimAtPath("/root/hair").GetAttribute("widths").Set([1.0])
    UsdGeom.NurbsCurves.Define(stage, "/root/more")
    stage.GetRootLayer().Save()
    with pytest.raises(StrandFileError, match="/root/more: NurbsCurves are not read"):
        read_strands(tmp_path / "h.usda")


def write_alembic(path: Path, points: Any, counts: Any, **how: Any) -> None:
    """Curves below a transform to twice the size and by (1, 2, 3), as another program would."""
    import imath
    from alembic3d import AbcGeom

    widths = np.asarray(how.get("widths", []), np.float32)
    scope = getattr(AbcGeom.GeometryScope, f"k{how.get('scope', 'Vertex')}Scope")
    kept = (
        imath.V3fArrayFromBuffer(np.asarray(points, np.float32)),
        imath.IntArrayFromBuffer(np.asarray(counts, np.int32)),
        imath.FloatArrayFromBuffer(widths) if len(widths) else None,
    )

    def fill(top: Any) -> None:
        above = AbcGeom.OXform(top, "groom")
        sample = AbcGeom.XformSample()
        sample.setTranslation(imath.V3d(1, 2, 3))
        sample.setScale(imath.V3d(2, 2, 2))
        above.getSchema().set(sample)
        AbcGeom.OCurves(above, "hair").getSchema().set(
            AbcGeom.OCurvesSchemaSample(
                kept[0],
                kept[1],
                getattr(AbcGeom.CurveType, f"k{how.get('kind', 'Linear')}"),
                getattr(AbcGeom.CurvePeriodicity, f"k{how.get('wrap', 'NonPeriodic')}"),
                AbcGeom.OFloatGeomParamSample(kept[2], scope)
                if kept[2] is not None
                else AbcGeom.OFloatGeomParamSample(),
                AbcGeom.OV2fGeomParamSample(),
                AbcGeom.ON3fGeomParamSample(),
                getattr(AbcGeom.BasisType, f"k{how.get('basis', 'No')}Basis"),
            )
        )

    write_archive(path, 0, fill)


def in_stage(points: Any) -> Any:
    """Points of `write_alembic`'s world, y up, in the stage's."""
    x, y, z = (2 * np.asarray(points) + (1, 2, 3)).T
    return np.stack([x, -z, y], axis=1)


@pytest.mark.parametrize(
    ("widths", "scope", "radii"),
    [
        ([], "Vertex", 4e-5),
        ([3e-4], "Constant", 3e-4),  # half of the width, twice the size
        ([2e-4, 6e-4], "Uniform", [2e-4, 2e-4, 2e-4, 6e-4, 6e-4]),
        ([5e-4, 4e-4, 0, 2e-4, 1e-4], "Vertex", [5e-4, 4e-4, 1e-6, 2e-4, 1e-4]),
    ],
)
def test_lines_of_alembic_and_their_widths(widths, scope, radii, tmp_path: Path) -> None:
    pytest.importorskip("imath", reason="the extra 'alembic' is not installed")
    write_alembic(tmp_path / "h.abc", np.vstack(LINES), [3, 2], widths=widths, scope=scope)
    strands = read_strands(tmp_path / "h.abc")
    assert strands.offsets.tolist() == [0, 3, 5]
    np.testing.assert_allclose(strands.points, in_stage(np.vstack(LINES)), atol=1e-6)
    np.testing.assert_allclose(strands.radius, radii, rtol=1e-5)


@pytest.mark.parametrize("basis", ["Catmullrom", "Bspline", "Bezier"])
def test_cubic_curves_of_alembic_are_followed(basis: str, tmp_path: Path) -> None:
    pytest.importorskip("imath", reason="the extra 'alembic' is not installed")
    both = np.vstack([ARC, ARC + 0.1])
    write_alembic(tmp_path / "h.abc", both, [10, 10], kind="Cubic", basis=basis)
    strands = read_strands(tmp_path / "h.abc")
    names = {"Catmullrom": "catmullRom", "Bspline": "bspline", "Bezier": "bezier"}
    truth = in_stage(scipys_curve(names[basis], "nonperiodic")(np.linspace(0, 1, 4001)))
    assert len(strands) == 2
    np.testing.assert_allclose(strands[0][[0, -1]], truth[[0, -1]], atol=1e-6)
    assert cKDTree(truth).query(strands[0])[0].max() < 4e-5


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"wrap": "Periodic"}, "/groom/hair: closed"),
        ({"kind": "VariableOrder"}, "/groom/hair: kVariableOrder curves .* are not read"),
        ({"kind": "Cubic", "basis": "Hermite"}, "curves of kHermiteBasis are not read"),
        ({"kind": "Cubic", "basis": "Bezier"}, "do not end at a segment's end"),
        ({"widths": [1e-4] * 3}, "3 widths for 2 curves with 5 points"),
    ],
)
def test_curves_of_alembic_that_are_not_clear_are_refused(how, words, tmp_path: Path) -> None:
    pytest.importorskip("imath", reason="the extra 'alembic' is not installed")
    write_alembic(tmp_path / "h.abc", np.vstack(LINES), [3, 2], **how)
    with pytest.raises(StrandFileError, match=rf"h\.abc: .*{words}"):
        read_strands(tmp_path / "h.abc")


def test_guides_of_a_groom_for_unreal_are_not_hair(two: Strands, tmp_path: Path) -> None:
    pytest.importorskip("imath", reason="the extra 'alembic' is not installed")

    def fill(top: Any) -> None:
        add_values(
            add_curves(top, "hair", two), "groom_id", np.arange(2, dtype=np.int32), "uniform"
        )
        guides = add_curves(top, "guides", two.subset([0]))
        add_values(guides, "groom_guide", np.array([1], np.int16), "constant")

    write_archive(tmp_path / "h.abc", 0, fill)
    assert read_strands(tmp_path / "h.abc").offsets.tolist() == [0, 3, 5]


@pytest.mark.parametrize("count", [4, pytest.param(300, marks=pytest.mark.slow)])
def test_damaged_archives_do_not_end_this_process(count, two: Strands, tmp_path: Path) -> None:
    """One to three wrong bytes, or an end that is missing."""
    pytest.importorskip("imath", reason="the extra 'alembic' is not installed")
    path, rng, said = tmp_path / "h.abc", np.random.default_rng(0), []
    write_strands(path, two)
    whole = path.read_bytes()
    for _ in range(count):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), rng.integers(1, 4)):
            data[at] ^= 1 << rng.integers(8)
        path.write_bytes(data if rng.random() < 0.8 else data[: rng.integers(len(data))])
        try:
            read_strands(path)
        except StrandFileError as error:
            said.append(str(error))
    assert said
    assert [s for s in said if not s.startswith(f"{path}: ") or "\n" in s] == []
