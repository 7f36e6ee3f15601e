"""NumPy's files as NumPy writes them, and as nobody should."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from reconstruction.files.numpy_files import read_array, read_arrays

ARRAYS = {
    "floats": np.linspace(0, 1, 6).reshape(2, 3),
    "fortran": np.asfortranarray(np.arange(6).reshape(2, 3)),
    "empty": np.zeros((0, 3), np.float32),
    "text": np.array(["left", "right"]),
    "one": np.array("modulation"),
    "truths": np.array([True, False]),
}


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_read_as_they_were_written(save, tmp_path):
    save(tmp_path / "a.npz", **ARRAYS)
    found = read_arrays(tmp_path / "a.npz")
    assert list(found) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert (found[name].dtype, found[name].shape) == (array.dtype, array.shape)
        np.testing.assert_array_equal(found[name], array)
        np.save(tmp_path / "a.npy", array)
        np.testing.assert_array_equal(read_array(tmp_path / "a.npy"), array)


def header(text: str) -> bytes:
    """An `.npy` file of this header and 24 bytes."""
    line = text.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(line).to_bytes(2, "little") + line + bytes(24)


def pickled() -> bytes:
    out = io.BytesIO()
    np.save(out, np.array([{}], object), allow_pickle=True)
    return out.getvalue()


SHAPE = "{'descr':'<f4','fortran_order':False,'shape':%s}"


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (header(SHAPE % "(99999999999,3)"), r"needs 1199999999988 bytes, the file has"),
        (header(SHAPE % "(-2,)"), "invalid shape"),
        (header(SHAPE % "(2,"), "header"),
        (header("(" * 90), "header"),
        (header("{'descr':'<c8','fortran_order':False,'shape':(1,)}"), "unexpected type"),
        (b"\x93NUMPY\x09\x00", "version"),
        (b"no array", "magic"),
        (b"", "magic|EOF"),
        (pickled(), "unexpected type object"),
    ],
)
def test_a_file_that_says_what_cannot_be_is_refused(data: bytes, why: str, tmp_path: Path):
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(ValueError, match=why):
        read_array(tmp_path / "a.npy")
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", data)
    with pytest.raises(ValueError, match=why):
        read_arrays(tmp_path / "a.npz")


def test_an_archive_that_is_cut_off_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.zeros(1000))
    whole = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "a.npz").write_bytes(whole[:-9])
    with pytest.raises(ValueError, match="not a whole"):
        read_arrays(tmp_path / "a.npz")
    with pytest.raises(FileNotFoundError):
        read_arrays(tmp_path / "none.npz")
