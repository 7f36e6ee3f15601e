"""Strand files: what is written is read back, and no broken file is believed."""

from __future__ import annotations

import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pxr import Usd, UsdGeom

from reconstruction import StrandFileError, Strands, read_strands, write_strands
from reconstruction.files.strands import READABLE, WRITABLE, read_poses

BOTH_WAYS = [suffix for suffix in WRITABLE if suffix in READABLE and suffix != ".abc"]

metres = st.floats(-2, 2, width=32)
radii = st.floats(2**-17, 2**-10, width=32)


@st.composite
def some_strands(draw: st.DrawFn) -> Strands:
    counts = np.array(draw(st.lists(st.integers(2, 6), max_size=6)), np.int64)
    total = int(counts.sum())
    points = draw(hnp.arrays(np.float32, (total, 3), elements=metres))
    radius = draw(st.one_of(radii, hnp.arrays(np.float32, total, elements=radii)))
    return Strands(points, np.concatenate([[0], np.cumsum(counts)]), radius)


@pytest.fixture
def two() -> Strands:
    line = np.array([[0, 0, 0], [0, 0, 0.01], [0, 0.01, 0.02]])
    return Strands.from_list([line, line[:2] + 0.1], radius=2e-4)


@pytest.mark.parametrize("suffix", BOTH_WAYS)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25)
@given(strands=some_strands())
def test_read_back(suffix: str, strands: Strands, tmp_path: Path) -> None:
    path = tmp_path / f"hair{suffix}"
    write_strands(path, strands)
    again = read_strands(path)
    np.testing.assert_array_equal(again.points, strands.points)
    np.testing.assert_array_equal(again.offsets, strands.offsets)
    if len(strands):
        widths = [np.broadcast_to(s.radius, len(s.points)) for s in (again, strands)]
        np.testing.assert_allclose(widths[0], widths[1], rtol=1e-6)
    assert not list(tmp_path.glob(".part-*"))


@pytest.mark.parametrize("suffix", [".npz", ".hair", ".usdc"])
def test_a_scalar_radius_stays_a_scalar(suffix: str, two: Strands, tmp_path: Path) -> None:
    write_strands(tmp_path / f"hair{suffix}", two)
    radius = read_strands(tmp_path / f"hair{suffix}").radius
    assert isinstance(radius, float)
    assert radius == pytest.approx(2e-4, rel=1e-6)


@pytest.mark.parametrize("suffix", [".npz", ".hair"])
def test_a_full_disk_error_names_the_file(suffix: str, two: Strands, tmp_path: Path) -> None:
    path = tmp_path / f"hair{suffix}"
    (tmp_path / f".part-hair{suffix}").symlink_to("/dev/full")
    with pytest.raises(OSError, match=rf"No space left on device: '{path}'"):
        write_strands(path, two)
    assert not list(tmp_path.iterdir())


def test_alembic_checks_free_space_before_writing(
    two: Strands, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its library ends the process where the disk is full. 5 points are 80 bytes."""
    pytest.importorskip("imath", reason="the extra 'alembic' is not installed")
    monkeypatch.setattr("reconstruction.files.durable._free", lambda _: 79)
    with pytest.raises(OSError, match=r"No space left on device: .*79 are free.*hair\.abc"):
        write_strands(tmp_path / "hair.abc", two)
    assert not list(tmp_path.iterdir())


def test_confidence_goes_to_npz_and_usd(two: Strands, tmp_path: Path) -> None:
    confidence = np.linspace(0, 1, len(two.points), dtype=np.float32)
    strands = Strands(two.points, two.offsets, two.radius, confidence)
    write_strands(tmp_path / "s.npz", strands)
    np.testing.assert_array_equal(read_strands(tmp_path / "s.npz").confidence, confidence)
    write_strands(tmp_path / "s.usdc", strands)
    stage = Usd.Stage.Open(str(tmp_path / "s.usdc"))
    primvar = UsdGeom.PrimvarsAPI(stage.GetDefaultPrim()).GetPrimvar("confidence")
    assert primvar.GetInterpolation() == UsdGeom.Tokens.vertex
    np.testing.assert_array_equal(primvar.Get(), confidence)


def test_a_confidence_that_is_none_is_an_error(two: Strands, tmp_path: Path) -> None:
    for bad in (np.zeros(3, np.float32), np.full(len(two.points), np.nan, np.float32)):
        arrays = {"points": two.points, "offsets": two.offsets, "confidence": bad}
        np.savez(tmp_path / "bad.npz", allow_pickle=False, **arrays)
        with pytest.raises(StrandFileError, match=r"bad\.npz: confidence"):
            read_strands(tmp_path / "bad.npz")


@pytest.mark.parametrize("suffix", BOTH_WAYS)
def test_cut_files_are_errors_that_name_the_file(suffix: str, two: Strands, tmp_path: Path) -> None:
    path = tmp_path / f"hair{suffix}"
    write_strands(path, two)
    whole = path.read_bytes()
    for keep in (0, 3, len(whole) // 4, len(whole) // 2, len(whole) - 5):
        path.write_bytes(whole[:keep])
        with pytest.raises(StrandFileError, match=f"hair{suffix}"):
            read_strands(path)


def test_unknown_formats_and_absent_files(two: Strands, tmp_path: Path) -> None:
    with pytest.raises(StrandFileError, match=r"readable are .*\.hair"):
        read_strands(tmp_path / "hair.obj")
    with pytest.raises(StrandFileError, match=r"writable are .*\.usdc"):
        write_strands(tmp_path / "hair.tfx", two)
    with pytest.raises(StrandFileError, match="no such file"):
        read_strands(tmp_path / "hair.npz")


def hair_bytes(
    magic: bytes = b"HAIR",
    strands: int = 2,
    points: int = 6,
    flags: int = 2,
    default: int = 2,
    body: bytes | None = None,
) -> bytes:
    xyz = np.arange(3 * 6, dtype="<f4")
    header = struct.pack(
        "<4s4I5f88s", magic, strands, points, flags, default, 1e-3, 0, 1, 1, 1, b""
    )
    return header + (xyz.tobytes() if body is None else body)


@pytest.mark.parametrize("magic", [b"HAIR", b"hair"])
def test_hair_without_segments_uses_the_default_count(magic: bytes, tmp_path: Path) -> None:
    path = tmp_path / "x.hair"
    path.write_bytes(hair_bytes(magic))
    strands = read_strands(path)
    assert strands.offsets.tolist() == [0, 3, 6]
    assert strands.points[4].tolist() == [12, 13, 14]
    assert strands.radius == pytest.approx(5e-4)


def test_hair_with_every_array_and_an_empty_strand(tmp_path: Path) -> None:
    segments = np.array([1, 0, 2], "<u2").tobytes()
    xyz = np.arange(18, dtype="<f4").tobytes()
    thickness = np.array([2, 2, 9, 4, 4, 4], "<f4").tobytes()
    path = tmp_path / "x.hair"
    body = segments + xyz + thickness + bytes(4 * 6) + bytes(12 * 6)
    path.write_bytes(hair_bytes(strands=3, flags=31, body=body))
    strands = read_strands(path)
    assert strands.offsets.tolist() == [0, 2, 5]
    assert strands.radius.tolist() == [1, 1, 2, 2, 2]  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"magic": b"RIAH"}, "not a .hair file"),
        ({"flags": 1}, "no points"),
        ({"flags": 2 | 64}, "unknown bits"),
        ({"strands": 4_000_000_000, "points": 4_000_000_000}, "need .* bytes, the file has"),
        ({"strands": 3}, "do not make"),
        ({"flags": 3, "body": b"\x07\0\x07\0" + bytes(72)}, "the segments make"),
        ({"body": np.full(18, np.nan, "<f4").tobytes()}, "byte 128: expected a finite position"),
    ],
)
def test_lying_hair_headers(bad: dict[str, object], words: str, tmp_path: Path) -> None:
    path = tmp_path / "x.hair"
    path.write_bytes(hair_bytes(**bad))  # type: ignore[arg-type]
    with pytest.raises(StrandFileError, match=rf"x\.hair: .*{words}"):
        read_strands(path)


def test_hair_cannot_hold_endless_strands(tmp_path: Path) -> None:
    long = Strands(np.zeros((65537, 3), np.float32), np.array([0, 65537]))
    with pytest.raises(StrandFileError, match="65536 segments"):
        write_strands(tmp_path / "x.hair", long)


def tfx_bytes(
    version: float = 4,
    strands: int = 2,
    vertices: int = 3,
    start: int | None = None,
    xyz: object = None,
) -> bytes:
    """A `.tfx` file whose vertex i is at (3i, 3i + 1, 3i + 2)."""
    points = np.arange(18, dtype="<f4").reshape(6, 3) if xyz is None else np.asarray(xyz, "<f4")
    counts = struct.pack("<f2I", version, strands, vertices)
    if version == 3:
        header = counts + bytes(132) + struct.pack("<I", 296 if start is None else start)
        return header.ljust(296, b"\0") + points.tobytes()
    header = counts + struct.pack("<I", 160 if start is None else start)
    masses = np.full((len(points), 1), 7, "<f4")
    return header.ljust(160, b"\0") + np.hstack([points, masses]).tobytes()


@pytest.mark.parametrize("version", [3, 4])
def test_tfx_of_both_versions_and_turned(version: int, tmp_path: Path) -> None:
    path = tmp_path / "x.TFX"
    path.write_bytes(tfx_bytes(version))
    strands = read_strands(path)
    assert strands.offsets.tolist() == [0, 3, 6]
    np.testing.assert_array_equal(strands.points.ravel(), np.arange(18))
    assert read_strands(path, up_axis="y").points[1].tolist() == [3, -5, 4]


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"vertices": 1}, "byte 8: 1 vertices a strand, at least 2"),
        ({"strands": 2**32 - 1, "vertices": 2**32 - 1}, "end at byte .*, the file has"),
        ({"strands": 3}, "3 strands of 3 vertices .* the file has"),
        ({"start": 8}, "from byte 8"),
        ({"start": 2**32 - 1}, "from byte 4294967295"),
        ({"xyz": np.full((6, 3), np.inf)}, r"byte \d+: expected a finite .*6 of 6"),
    ],
)
def test_lying_tfx_headers(
    version: int, bad: dict[str, object], words: str, tmp_path: Path
) -> None:
    path = tmp_path / "x.tfx"
    path.write_bytes(tfx_bytes(version, **bad))  # type: ignore[arg-type]
    with pytest.raises(StrandFileError, match=rf"x\.tfx: .*{words}"):
        read_strands(path)


@pytest.mark.parametrize("version", [3, 4])
def test_cut_tfx_files(version: int, tmp_path: Path) -> None:
    path = tmp_path / "x.tfx"
    whole = tfx_bytes(version)
    for keep in (0, 11, 100, 159, len(whole) - 1):
        path.write_bytes(whole[:keep])
        with pytest.raises(StrandFileError, match=r"x\.tfx: .*truncated"):
            read_strands(path)


def test_other_tfx_versions_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.tfx"
    path.write_bytes(tfx_bytes(2))
    with pytest.raises(StrandFileError, match="byte 0: TressFX version 2, only 3 and 4"):
        read_strands(path)


def data_bytes(*strands: list[list[float]], count: int | None = None) -> bytes:
    out = struct.pack("<i", len(strands) if count is None else count)
    for points in strands:
        out += struct.pack("<i", len(points)) + np.asarray(points, "<f4").tobytes()
    return out


A_STRAND = [[0.0, 0, 0], [0, 0, 1], [0, 1, 2]]


def test_data_leaves_out_roots_without_hair(tmp_path: Path) -> None:
    path = tmp_path / "x.data"
    path.write_bytes(data_bytes([[9, 9, 9]], A_STRAND, [], [[5, 6, 7]], [[1, 2, 3], [4, 5, 6]]))
    strands = read_strands(path)
    assert strands.offsets.tolist() == [0, 3, 5]
    assert strands.points.tolist() == [*A_STRAND, [1, 2, 3], [4, 5, 6]]
    assert strands.radius == 4e-5
    path.write_bytes(data_bytes())
    assert len(read_strands(path)) == 0


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25)
@given(strands=some_strands())
def test_data_of_any_strands(strands: Strands, tmp_path: Path) -> None:
    path = tmp_path / "x.data"
    path.write_bytes(data_bytes(*(strands[i].tolist() for i in range(len(strands)))))
    again = read_strands(path)
    np.testing.assert_array_equal(again.points, strands.points)
    np.testing.assert_array_equal(again.offsets, strands.offsets)


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        (b"", "0 bytes, a .data file has at least 4"),
        (data_bytes(count=-1), "byte 0: -1 strands"),
        (data_bytes(A_STRAND, count=2**31 - 1), "byte 0: 2147483647 strands need at least"),
        (data_bytes(A_STRAND, count=2), "byte 44: strand 1 of 2 .* the file has 44"),
        (data_bytes(A_STRAND)[:-1], "byte 4: strand 0 of 1 has 3 points, .* byte 44, .* has 43"),
        (data_bytes(A_STRAND)[:9], "byte 4: strand 0"),
        (data_bytes(A_STRAND) + b"abc", "byte 44: the 1 strands end here, the file has 47"),
        (struct.pack("<ii", 1, -5), "byte 4: strand 0 of 1 has -5 points"),
        (struct.pack("<ii", 1, 2**31 - 1), "byte 4: strand 0 of 1 has 2147483647 points"),
        (data_bytes(A_STRAND, [[0, 0, 0], [0, np.nan, 0]]), r"byte 60: .*nan.*1 of 5"),
    ],
)
def test_lying_data_files(raw: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "x.data"
    path.write_bytes(raw)
    with pytest.raises(StrandFileError, match=rf"x\.data: {words}"):
        read_strands(path)


def write_npy(path: Path, name: str, header: bytes, data: bytes) -> None:
    with zipfile.ZipFile(path, "a") as archive:
        text = header.ljust(117) + b"\n"
        archive.writestr(name, b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        (b"{'descr':'<f4','fortran_order':False,'shape':(99999999999,3)}", "needs .* bytes"),
        (b"{'descr':'|O','fortran_order':False,'shape':(1,3)}", "unexpected type"),
        (b"{'descr':'<f4','fortran_order':False,'shape':(-1,3)}", "invalid shape"),
        (b"{'descr':'<f4','fortran_order':False,'shape':(6,)}", r"must be \(N, 3\)"),
        (b"nonsense", "points"),
    ],
)
def test_lying_npz_headers(header: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    np.savez(path, offsets=np.array([0, 2]))
    write_npy(path, "points.npy", header, bytes(24))
    with pytest.raises(StrandFileError, match=words):
        read_strands(path)


def test_npz_members(tmp_path: Path, two: Strands) -> None:
    path = tmp_path / "x.npz"
    np.savez(path, points=two.points)
    with pytest.raises(StrandFileError, match=r"offsets is missing; the archive holds \['points'"):
        read_strands(path)
    np.savez_compressed(path, points=two.points, offsets=two.offsets, more=np.ones(3))
    assert read_strands(path).radius == 4e-5
    np.savez(path, points=two.points, offsets=two.offsets + 1)
    with pytest.raises(StrandFileError, match="offsets must run from 0"):
        read_strands(path)


def test_sintels_groom(shared_data: Callable[[str], Path]) -> None:
    folder = shared_data("sintel")
    files = sorted(folder.glob("*.tfx"))
    strands = read_strands(files[0], up_axis="y")
    truth = read_strands(folder / "sintel.npz")
    assert len(strands) == 11_400
    np.testing.assert_array_equal(strands.offsets, truth.offsets)
    moved = strands.points - np.array([0, 0, 1.56])
    np.testing.assert_allclose(moved, truth.points, atol=2e-6)


def test_the_ponytail(shared_data: Callable[[str], Path]) -> None:
    folder = shared_data("ponytail")
    names = ("front_top", "side", "back", "tail")
    parts = [read_strands(folder / f"{name}.tfx", up_axis="y") for name in names]
    truth = read_strands(folder / "ponytail.npz")
    assert [len(part) for part in parts] == [876, 3066, 517, 474]
    points = np.concatenate([part.points for part in parts]) * 0.003 - np.array([0, 0, 0.24])
    np.testing.assert_allclose(points, truth.points, atol=1e-6)


def test_archives_of_any_size_are_read(tmp_path: Path) -> None:
    """24 poses of a million points are 288 MB. An archive may begin anywhere in its file: this one
    does behind a hole as large as that, which takes no room on the disk."""
    points = np.array([[0, 0, 0], [0, 0, 0.1]], np.float32)
    with (tmp_path / "poses.npz").open("wb") as file:
        file.seek(24 * 12 * 1_000_000)
        np.savez(file, points=np.stack([points, points + 1]), offsets=np.array([0, 2]))
    np.testing.assert_array_equal(read_poses(tmp_path / "poses.npz")[1].points, points + 1)


def test_a_thickness_of_0_is_a_tip(tmp_path: Path) -> None:
    path = tmp_path / "x.hair"
    xyz = np.arange(18, dtype="<f4").tobytes()
    path.write_bytes(hair_bytes(flags=6, body=xyz + np.array([4, 2, 0, 4, 2, 0], "<f4").tobytes()))
    np.testing.assert_allclose(read_strands(path).radius, [2, 1, 1e-6, 2, 1, 1e-6])
    path.write_bytes(hair_bytes(flags=6, body=xyz + np.array([4, 2, -1] * 2, "<f4").tobytes()))
    with pytest.raises(StrandFileError, match="the width of point 2 is -1"):
        read_strands(path)


@pytest.mark.parametrize("less", [0, 1])
def test_hair_without_a_header(less: int, tmp_path: Path) -> None:
    """Points or segments (one less) for each strand, by the size of the file."""
    path, counts = tmp_path / "x.hair", np.array([3, 2, 4])
    xyz = np.random.default_rng(0).normal(size=(9, 3)).astype("<f4")
    raw = struct.pack("<2I", 3, 9) + (counts - less).astype("<u2").tobytes() + xyz.tobytes()
    path.write_bytes(raw)
    strands = read_strands(path)
    assert strands.offsets.tolist() == [0, 3, 5, 9]
    np.testing.assert_array_equal(strands.points, xyz)
    for bad in (raw[:-1], raw + b"x", raw[:8] + b"\x09" + raw[9:]):
        path.write_bytes(bad)
        with pytest.raises(StrandFileError, match=r"not a \.hair file|truncated"):
            read_strands(path)


def write_ply(path: Path, points: np.ndarray, columns: dict[str, np.ndarray], form: str,
              edges: np.ndarray | None = None) -> None:  # fmt: skip
    head = f"ply\nformat {form} 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property float {n}\n" for n in "xyz")
    head += "".join(f"property uchar {n}\n" for n in columns)
    order = ">" if "big" in form else "<"
    fields = [("p", order + "f4", 3), *((n, "u1") for n in columns)]
    rows = np.zeros(len(points), fields)
    rows["p"] = points
    for name, values in columns.items():
        rows[name] = values
    if edges is not None:
        head += f"element edge {len(edges)}\nproperty int vertex1\nproperty int vertex2\n"
    if form == "ascii":
        body = "".join(" ".join(map(str, [*r[0], *list(r)[1:]])) + "\n" for r in rows).encode()
        body += (
            "".join(f"{a} {b}\n" for a, b in edges if True).encode() if edges is not None else b""
        )
    else:
        body = rows.tobytes() + (b"" if edges is None else edges.astype(order + "i4").tobytes())
    path.write_bytes(f"{head}end_header\n".encode() + body)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("how", ["colours", "twins", "groups", "gaps", "numbers", "edges"])
def test_strands_of_a_ply(form: str, how: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    roots = 0.08 * rng.normal(size=(12, 1, 3))
    length = rng.uniform(0.02, 0.3, (12, 1, 1))
    points = roots + length * np.linspace(0, 1, 25)[:, None] * (0, 0, 1)
    points += 0.01 * np.sin(20 * points[..., :1])
    points[3, 11] += 0.05  # a kink is no end
    points, counts = points.reshape(-1, 3).astype(np.float32), np.full(12, 25)
    columns, edges = {}, None
    if how in ("colours", "twins", "groups"):
        colour = rng.integers(0, 255, (12, 3))
        if how == "twins":  # two neighbours of one colour
            colour[4] = colour[5]
        if how == "groups":
            colour[:6], colour[6:] = 7, 9
        columns = dict(zip(("red", "green", "blue"), np.repeat(colour, 25, 0).T, strict=True))
    elif how != "gaps":
        counts = np.array([25, 50, 20, 5, *[25] * 8])
        number = np.repeat(np.arange(12), counts)
        columns = {"strand_id": number} if how == "numbers" else {}
        first = np.flatnonzero(number[1:] == number[:-1])
        edges = np.stack([first, first + 1], axis=1) if how == "edges" else None
    write_ply(tmp_path / "s.ply", points, columns, form, edges)
    strands = read_strands(tmp_path / "s.ply")
    assert np.diff(strands.offsets).tolist() == counts.tolist()
    np.testing.assert_allclose(strands.points, points, rtol=1e-6)


def test_a_ply_whose_strands_are_unknown_is_refused(tmp_path: Path) -> None:
    cloud = np.random.default_rng(0).normal(size=(300, 3))
    write_ply(tmp_path / "s.ply", cloud, {}, "ascii")
    with pytest.raises(StrandFileError, match="the strands' ends are unknown"):
        read_strands(tmp_path / "s.ply")
    for edge in ([0, 2], [299, 300], [-1, 0]):
        write_ply(tmp_path / "s.ply", cloud, {}, "ascii", np.array([edge]))
        with pytest.raises(StrandFileError, match="an edge joins vertices that do not follow"):
            read_strands(tmp_path / "s.ply")


def test_long_strands_are_resampled_by_arc_length() -> None:
    """A circle of 400 uneven points: 255 lie on it, evenly, ends kept, width with the angle."""
    angle = 1.5 * np.linspace(0, 1, 400) ** 2
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    short = np.array([[0.0, 0, 0], [1, 1, 1]])
    radius = np.r_[1 + angle, 1, 1].astype(np.float32)
    few = Strands(np.vstack([circle, short]), np.array([0, 400, 402]), radius).at_most(255)
    assert few.offsets.tolist() == [0, 255, 257]
    even = np.linspace(0, 1.5, 255)
    expected = np.stack([np.cos(even), np.sin(even), 0 * even], axis=1)
    np.testing.assert_allclose(few[0], expected, atol=2e-5)
    np.testing.assert_allclose(few.radius[:255], 1 + even, atol=1e-4)
    np.testing.assert_array_equal(few[1], short)
    assert few.at_most(255) is few
