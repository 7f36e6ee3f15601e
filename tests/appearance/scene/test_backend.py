"""What is said where no back end can run: before Mitsuba is imported and Dr.Jit aborts."""

import os
import subprocess
import sys
from pathlib import Path

import drjit
import mitsuba as mi
import numpy as np
import pytest

from appearance.scene.backend import ensure_backend
from reconstruction.array_backend import for_kernels
from reconstruction.libllvm import BackendError, find_libllvm


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
        [sys.executable, "-m", "appearance.scene.backend"],
        env={**os.environ, "DRJIT_LIBLLVM_PATH": str(old)},
        cwd=Path(__file__).parents[3],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 1
    assert "apt-get install libllvm19" in done.stderr
    assert "Traceback" not in done.stderr


_WITHOUT_LIBATOMIC = """
import ctypes, sys
load = ctypes.CDLL
def without(name, *more, **options):
    if "libatomic" in str(name):
        raise OSError(name)
    return load(name, *more, **options)
ctypes.CDLL = without
from stage_service.cli import main
sys.exit(main(["render", sys.argv[1]]))
"""


def test_a_missing_libatomic_is_a_sentence(tmp_path):
    """Mitsuba's wheel needs it and says nothing of it; a fresh Debian has none."""
    command = [sys.executable, "-c", _WITHOUT_LIBATOMIC, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert "apt-get install libatomic1" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("package", ["appearance", "reconstruction.light_codes.search"])
def test_the_library_is_chosen_before_dr_jit_loads_one(package):
    code = f"import sys, {package}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    modules = done.stdout.split()
    assert modules.index("reconstruction.libllvm") < modules.index("drjit")


def test_a_usable_library_is_found_and_the_variant_is_set():
    assert Path(find_libllvm()).is_file()
    chosen = ensure_backend()
    assert mi.variant() == chosen == ensure_backend()


_AT_AN_EDGE = """
import ctypes, mmap
import numpy as np
from appearance.scene.backend import ensure_backend
from reconstruction.array_backend import for_kernels
page = mmap.PAGESIZE
memory = mmap.mmap(-1, 2 * page)
start = ctypes.addressof(ctypes.c_char.from_buffer(memory))
protect = ctypes.CDLL(None, use_errno=True).mprotect
protect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
assert protect(start + page, page, 0) == 0
five = np.frombuffer(memory, np.float32, count=5, offset=page - 20)
five[:] = range(5)
ensure_backend("llvm_ad_rgb")
import drjit
import mitsuba as mi
print((mi.Float(for_kernels(five)) + 1).numpy().tolist())
"""


def test_an_array_that_ends_where_memory_ends_does_not_end_the_process():
    """Without `for_kernels` this is a segfault: kernels read the last packet whole."""
    done = subprocess.run([sys.executable, "-c", _AT_AN_EDGE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[1.0, 2.0, 3.0, 4.0, 5.0]"


@pytest.mark.parametrize("shape", [(1,), (17,), (3, 5, 2)])
def test_arrays_for_kernels_begin_at_a_packet_and_have_room_after_their_end(shape):
    values = np.asfortranarray(np.arange(np.prod(shape)).reshape(shape))
    copy = for_kernels(values, np.uint32)
    assert copy.flags.c_contiguous
    assert (copy == values).all()
    owner = copy
    while isinstance(owner.base, np.ndarray):
        owner = owner.base
    assert copy.ctypes.data % 128 == 0
    assert owner.ctypes.data + owner.nbytes - copy.ctypes.data - copy.nbytes >= 128


@pytest.mark.parametrize(("variant", "said"), [("cuda_ad_rgb", "NVIDIA GPU"), ("llvm", "'llvm'")])
def test_a_variant_that_does_not_run_here_is_a_sentence(variant, said, monkeypatch):
    monkeypatch.setattr(drjit, "has_backend", lambda backend: False)
    with pytest.raises(BackendError, match=said):
        ensure_backend(variant)
