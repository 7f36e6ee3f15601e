"""Fault files."""

from __future__ import annotations

import json

import pytest

from simulators.peers.faults import FaultError, Faults


def load(tmp_path, content):
    file = tmp_path / "faults.json"
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    return Faults.load(file, ["cam_a"])


def test_a_drop_shows_once_and_a_mute_stays(tmp_path):
    faults = load(
        tmp_path,
        [
            {"device": "camera", "camera": "cam_a", "kind": "drop", "pulse": 3},
            {"device": "camera", "camera": "cam_a", "kind": "mute", "pulse": 5},
        ],
    )
    assert not faults.at("camera", "drop", 2, "cam_a")
    assert not faults.at("camera", "drop", 3, "cam_b")
    assert faults.at("camera", "drop", 3, "cam_a")
    assert not faults.at("camera", "drop", 3, "cam_a")
    assert [faults.since("camera", "mute", n, "cam_a") for n in (4, 5, 9)] == [False, True, True]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "Expecting property name"),
        ({}, "expected a list"),
        ([{"device": "camera"}], "fault 1: expected device, kind, pulse"),
        ([{"device": "camera", "kind": "drop", "pulse": 1}], "camera faults"),
        ([{"device": "lights", "kind": "mute", "pulse": 1}], "lights: .*hang"),
        ([{"device": "lights", "kind": "hang", "pulse": -1}], "pulse must be"),
        ([{"device": "camera", "kind": "drop", "pulse": 1, "camera": "x"}], "no camera 'x'"),
    ],
)
def test_a_wrong_file_is_an_error_that_names_it(tmp_path, content, said):
    with pytest.raises(FaultError, match=r"faults\.json.*" + said):
        load(tmp_path, content)


def test_a_missing_file_is_an_error(tmp_path):
    with pytest.raises(FaultError, match="nothing"):
        Faults.load(tmp_path / "nothing", [])
