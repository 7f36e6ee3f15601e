"""OpenEXR files: lossless, whole or not there."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from reconstruction import read_exr, write_exr
from reconstruction.files.durable import PAGE
from reconstruction.files.exr import UncompressedExr


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
@given(
    image=hnp.arrays(
        np.float32,
        st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3)),
        elements=st.floats(width=32, allow_nan=False),
    ),
    compress=st.booleans(),
    scale=st.floats(0.125, 8, width=32),
)
def test_every_float_comes_back(
    image: np.ndarray, compress: bool, scale: float, tmp_path: Path
) -> None:
    path = tmp_path / "x.exr"
    write_exr(path, image, {"countScale": scale, "note": "tilt 2°"}, compress=compress)
    again, attributes = read_exr(path)
    np.testing.assert_array_equal(again, image)
    assert again.dtype == np.float32
    assert attributes["countScale"] == scale
    assert attributes["note"] == "tilt 2°"
    assert [p.name for p in tmp_path.iterdir()] == ["x.exr"]


def test_half_floats_are_read(tmp_path: Path) -> None:
    image = np.arange(24, dtype=np.float16).reshape(2, 4, 3) / 8
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": image}).write(str(tmp_path / "h.exr"))
    again, _ = read_exr(tmp_path / "h.exr")
    assert again.dtype == np.float32
    np.testing.assert_array_equal(again, image.astype(np.float32))


def test_an_alpha_channel_is_no_colour(tmp_path: Path) -> None:
    image = np.arange(32, dtype=np.float32).reshape(2, 4, 4)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGBA": image}).write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[0], image[..., :3])


def test_broken_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "x.exr"
    with pytest.raises(ValueError, match=r"x\.exr: cannot be read"):
        read_exr(path)
    write_exr(path, np.random.default_rng(0).random((40, 50, 3)), compress=True)
    whole = path.read_bytes()
    for keep in (0, 3, 100, len(whole) // 2):
        path.write_bytes(whole[:keep])
        with pytest.raises(ValueError, match=r"x\.exr: "):
            read_exr(path)


def test_other_channels_are_refused(tmp_path: Path) -> None:
    header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}
    depth = np.zeros((4, 5), np.float32)
    OpenEXR.File(header, {"Z": depth}).write(str(tmp_path / "z.exr"))
    with pytest.raises(ValueError, match=r"z\.exr: expected channels R, G and B"):
        read_exr(tmp_path / "z.exr")


@pytest.mark.parametrize("shape", [(4, 5), (4, 5, 1), (4, 5, 4)])
def test_only_colour_images_are_written(tmp_path: Path, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"expected an image of shape \(H, W, 3\)"):
        write_exr(tmp_path / "x.exr", np.zeros(shape))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
@given(
    image=hnp.arrays(
        np.float32,
        st.tuples(st.integers(1, 90), st.integers(1, 9), st.just(3)),
        elements=st.floats(width=32, allow_nan=False),
    ),
    scale=st.floats(0.125, 8, width=32),
)
def test_our_uncompressed_file_is_the_reference_writers(
    image: np.ndarray, scale: float, tmp_path: Path
) -> None:
    attributes = {"countScale": scale, "note": "tilt 2°"}
    exr = UncompressedExr(image.shape[0], image.shape[1])
    exr.fill(np.zeros_like(image), {"note": "longer than what comes after it", "other": 1.0})
    whole = exr.fill(image, attributes)
    assert len(whole) % PAGE == 0
    (tmp_path / "ours.exr").write_bytes(whole)
    write_exr(tmp_path / "reference.exr", image, attributes, compress=False)
    ours, theirs = (OpenEXR.File(str(tmp_path / f"{n}.exr")) for n in ("ours", "reference"))
    np.testing.assert_equal(
        ours.header(), theirs.header() | {"channels": ours.header()["channels"]}
    )
    assert [str(c) for c in ours.header()["channels"]] == [
        str(c) for c in theirs.header()["channels"]
    ]
    np.testing.assert_array_equal(
        ours.channels()["RGB"].pixels.view(np.uint32),
        theirs.channels()["RGB"].pixels.view(np.uint32),
    )
    np.testing.assert_array_equal(read_exr(tmp_path / "ours.exr")[0], image)


BY_MITSUBA = """
import sys
import drjit, mitsuba, numpy as np
drjit.set_thread_count(2)  # of one Mitsuba waits for ever
mitsuba.set_variant("scalar_rgb")
np.save(sys.argv[2], np.array(mitsuba.Bitmap(sys.argv[1])))
"""


def test_mitsuba_reads_our_uncompressed_file(tmp_path: Path) -> None:
    image = np.random.default_rng(0).normal(size=(37, 53, 3)).astype(np.float32)
    whole = UncompressedExr(37, 53).fill(image, {"exposureTime": 0.01})
    (tmp_path / "x.exr").write_bytes(whole)
    files = [str(tmp_path / "x.exr"), str(tmp_path / "x.npy")]
    subprocess.run([sys.executable, "-c", BY_MITSUBA, *files], check=True)
    np.testing.assert_array_equal(np.load(tmp_path / "x.npy"), image)


def test_attributes_that_do_not_fit_are_refused() -> None:
    exr, image = UncompressedExr(2, 2), np.zeros((2, 2, 3), np.float32)
    with pytest.raises(ValueError, match="the attributes exceed"):
        exr.fill(image, {"note": "x" * 9000})
    with pytest.raises(ValueError, match="1 to 31 bytes"):
        exr.fill(image, {"x" * 32: 1.0})
