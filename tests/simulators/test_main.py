"""The command that runs the simulated rig."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tomllib

import pytest
from simulating import small_subject

from simulators.__main__ import main

RIG = """
[[cameras]]
name = "cam"
position = [0.0, -0.95, 0.1]
target = [0.0, 0.0, 0.0]
fov_deg = 22.0
width = 8
height = 8
[[lights]]
name = "lamp"
position = [0.0, -1.2, 0.3]
intensity = [8.0, 8.0, 8.0]
"""


@pytest.fixture
def rig_file(tmp_path):
    file = tmp_path / "rig.toml"
    file.write_text(RIG)
    return file


def run(*arguments, **more):
    command = [sys.executable, "-m", "simulators", *map(str, arguments)]
    return subprocess.Popen(command, stdout=-1, stderr=-1, text=True, **more)


def test_the_command_says_when_it_is_ready_and_ends_on_sigterm(rig_file, tmp_path):
    state, truth = tmp_path / "state", tmp_path / "truth"
    words = ("--rig", rig_file, "--state", state, "--truth", truth, "--ports", "auto")
    with run(*words, *small_subject(tmp_path)) as process:
        ready = json.loads(process.stdout.readline())
        devices = tomllib.loads((state / "devices.toml").read_text())["devices"]
        assert ready["ready"] is True
        assert {k: ready[k] for k in devices} == devices
        assert set(devices) == {"lights", "trigger", "cameras"}
        assert (state / "trigger").is_symlink()
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
        assert process.stderr.read() == ""
    assert list(state.iterdir()) == []
    names = {"strands.npz", "head.obj", "appearance.json", "poses.json", "exposures.jsonl"}
    assert {f.name for f in truth.iterdir()} == names
    assert set(json.loads((truth / "appearance.json").read_text())) == {"hair", "skin"}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--subject", "afro", "--state", "s"], "unknown subject 'afro'"),
        (["--state", "s", "--faults", "none.json"], "none.json"),
        (["--state", "x", "--seed", "-1"], "--seed must be at least 0, got -1"),
        (["--truth-only", "x", "--drift-mm", "nan"], "got 1 and nan"),
        (["--truth-only", "x", "--drift-mm", "inf"], "got 1 and inf"),
        ([], "--state FOLDER is required"),
    ],
)
def test_wrong_arguments_end_it_with_code_2(rig_file, capsys, arguments, said):
    try:
        code: int | str | None = main(["--rig", str(rig_file), *arguments])
    except SystemExit as ended:
        code = ended.code
    assert code == 2
    assert said in capsys.readouterr().err


def test_an_unknown_variant_is_reported_before_devices_are_ready(
    rig_file, tmp_path, capsys, monkeypatch
):
    monkeypatch.setenv("HAIRSTAGE_VARIANT", "nonsense")
    assert main(["--rig", str(rig_file), "--state", str(tmp_path / "state")]) == 1
    said = capsys.readouterr()
    assert said.err.startswith("simulators: there is no variant 'nonsense'")
    assert said.out == "", "nobody is told that it is ready"


def test_a_rig_whose_frames_need_more_memory_than_is_free_is_refused(
    rig_file, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("simulators.frames.responses.free_memory", lambda: 0.2)
    words = ["--rig", rig_file, "--state", tmp_path / "state", *small_subject(tmp_path)]
    assert main([str(w) for w in words]) == 2
    error = capsys.readouterr().err
    assert "of 1 lights take about 0.3 GB of memory in 1 rendering processes, and 0.2 GB" in error
    assert "use fewer --processes" in error
