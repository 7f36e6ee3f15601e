"""`hairstage doctor` on machines that lack something."""

from __future__ import annotations

import json
import os
import socket
from collections import namedtuple

import pytest

from stage_service.cli import doctor, main

Usage = namedtuple("Usage", "total used free")


@pytest.fixture
def states(capsys, tmp_path):
    def found(*words: str) -> tuple[int, dict[str, tuple[str, str]]]:
        code = main(["doctor", "--json", "--out", str(tmp_path / "new" / "out"), *words])
        data = json.loads(capsys.readouterr().out)
        assert data["demo"] == (code == 0)
        return code, {c["name"]: (c["state"], c["remedy"]) for c in data["checks"]}

    return found


def test_a_machine_that_runs_the_tests_can_run_the_demo(states, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        code, found = states("--port", str(taken.getsockname()[1]))
    assert code == 0
    assert found["libLLVM"] == ("ok", "")
    assert found["port"][0] == "limited"
    assert "--port" in found["port"][1]
    assert not (tmp_path / "new").exists()


def test_an_old_library_is_missing_and_the_package_is_named(states, monkeypatch, tmp_path):
    (tmp_path / "libLLVM-15.so").touch()
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM-15.so"))
    code, found = states()
    assert code == 1
    assert found["libLLVM"][0] == "missing"
    assert "apt-get install libllvm19" in found["libLLVM"][1]


@pytest.mark.parametrize(
    ("gb", "state", "code"), [(9, "ok", 0), (3.5, "limited", 0), (0.5, "missing", 1)]
)
@pytest.mark.parametrize("what", ["memory", "disk"])
def test_room_is_enough_for_the_demo_the_quick_demo_or_none(
    states, monkeypatch, what, gb, state, code
):
    monkeypatch.setattr(doctor, "_kernels", lambda: iter(()))
    if what == "memory":
        monkeypatch.setattr(doctor, "memory_bytes", lambda: gb * 1e9)
    else:
        monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _: Usage(0, 0, gb * 1e9))
    found = states()
    assert (found[0], found[1][what][0]) == (code, state)


def test_without_pseudo_terminals_there_is_no_simulated_rig(states, monkeypatch):
    def none() -> None:
        raise OSError("out of pty devices")

    monkeypatch.setattr(doctor, "_kernels", lambda: iter(()))
    monkeypatch.setattr(os, "openpty", none)
    monkeypatch.setattr(doctor.pty, "openpty", none)
    code, found = states()
    assert (code, found["simulated rig"][0]) == (1, "missing")
