"""What is said where no back end can run: before Mitsuba is imported and Dr.Jit aborts."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from appearance.backend import BackendError, ensure_backend, find_libllvm


def test_an_old_libllvm_is_refused_with_what_to_install(tmp_path, monkeypatch):
    old = tmp_path / "libLLVM-15.so"
    old.touch()
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(old))
    with pytest.raises(BackendError, match=r"libLLVM-15\.so \(LLVM 15\).*libllvm19"):
        find_libllvm()


def test_an_absent_library_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM-19.so"))
    with pytest.raises(BackendError, match="apt-get install libllvm19"):
        find_libllvm()


def test_a_newer_name_that_does_not_load_is_refused(tmp_path, monkeypatch):
    broken = tmp_path / "libLLVM-19.so"
    broken.write_text("not a library")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(broken))
    with pytest.raises(BackendError, match="needs libLLVM 16 or newer"):
        find_libllvm()


def test_the_message_comes_before_the_crash(tmp_path):
    """In a fresh process: the sentence, and no abort of Dr.Jit's."""
    old = tmp_path / "libLLVM-15.so"
    old.touch()
    done = subprocess.run(
        [sys.executable, "-m", "appearance.backend"],
        env={**os.environ, "DRJIT_LIBLLVM_PATH": str(old)},
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 1
    assert "apt-get install libllvm19" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_usable_library_is_found_and_the_variant_is_set():
    assert Path(find_libllvm()).is_file()
    chosen = ensure_backend()
    import mitsuba as mi

    assert mi.variant() == chosen == ensure_backend()
