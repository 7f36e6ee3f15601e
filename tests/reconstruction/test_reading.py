"""Files and texts that somebody else wrote: nothing hangs, and what JSON cannot mean is refused."""

from __future__ import annotations

import os

import pytest

from reconstruction import read_obj
from reconstruction.reading import DEEPEST, parse_json, printable, read_json


def test_sound_json_is_read_as_it_was_meant():
    assert parse_json(rb'{"a": [1, 2.5, "\ud83d\ude00", null, true]}') == {
        "a": [1, 2.5, "😀", None, True]
    }
    deep = parse_json("[" * DEEPEST + "]" * DEEPEST)
    for _ in range(DEEPEST - 1):
        (deep,) = deep
    assert deep == []
    with pytest.raises(ValueError, match="utf-8"):
        parse_json(b'"\xff"')


def test_only_plain_files_are_read(tmp_path):
    """Nobody ever writes to this FIFO: whoever opens it to read waits for ever."""
    os.mkfifo(tmp_path / "fifo.obj")
    for path in (tmp_path / "fifo.obj", tmp_path, "/dev/zero"):
        with pytest.raises((ValueError, OSError), match="no plain file"):
            read_obj(path)
    with pytest.raises(ValueError, match="no plain file"):
        read_json(tmp_path / "fifo.obj")


def test_a_name_that_is_not_utf_8_can_be_printed():
    assert printable("caf\udce9 ü") == r"caf\udce9 ü"
