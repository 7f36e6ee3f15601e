"""`hairstage doctor`: whether this machine can run the demo, and what is missing."""

from __future__ import annotations

import argparse
import json
import os
import platform
import pty
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from reconstruction.report.report import usable_cores
from stage_service.cli.stage.processes import DEFAULT_PORT
from stage_service.cli.support.commands import FAILED, Commands, Output, add_command, whole

DISK_GB, QUICK_DISK_GB = 4.0, 1.0
MEMORY_GB, QUICK_MEMORY_GB = 6.0, 3.0
"""Free disk and memory of the machine that the demo needs, and the quick demo."""
KERNEL = """
import json, sys
try:
    from appearance.scene.backend import ensure_backend
    from reconstruction.libllvm import find_libllvm
    import drjit, mitsuba
    variant = ensure_backend()
    assert (mitsuba.Float(1) + drjit.arange(mitsuba.Float, 3)).numpy().tolist() == [1, 2, 3]
except RuntimeError as error:
    sys.exit(str(error))
library = find_libllvm() if variant.startswith("llvm") else "not used"
print(json.dumps([variant, library, drjit.has_backend(drjit.JitBackend.CUDA)]))
"""
"""Runs in a process of its own, because a wrong library aborts it."""
EXTRAS = {
    "basler": ("pypylon", "Basler cameras"),
    "aravis": ("gi", "other GenICam cameras"),
    "gphoto2": ("gphoto2", "DSLRs"),
    "alembic": ("alembic3d", "Alembic files"),
}


@dataclass(frozen=True)
class Check:
    """What was found; of "limited" and "missing", with which no demo runs, `remedy` is what to
    do."""

    name: str
    state: Literal["ok", "limited", "missing"]
    found: str
    remedy: str = ""


def add(commands: Commands) -> None:
    """Add the command."""
    doctor = add_command(commands, "doctor", run)
    doctor.add_argument("--out", type=Path, default=Path("runs"), help="folder of the results")
    doctor.add_argument(
        "--port", type=whole(0, 65535), default=DEFAULT_PORT, help="port of the service"
    )


def run(args: argparse.Namespace, output: Output) -> int:
    """Check this machine: what the demo and a service need, and what is missing.

    Exit code 0 if the demo can run, else 1.
    """
    checks = [_system()]
    if checks[0].state == "ok":
        checks += [
            *_kernels(),
            _cores(),
            _memory(memory_bytes() / 1e9),
            _disk(args.out.resolve()),
            _terminals(),
            _port(args.port),
            *_serial_ports(Path("/dev/serial/by-id")),
            *_extras(),
        ]
    fine = all(check.state != "missing" for check in checks)
    lines = []
    for c in checks:
        lines.append(f"{c.state:<9}{c.name:<15}{c.found}")
        lines += [f"{'':<24}{c.remedy}"] if c.remedy else []
    lines.append("The demo can run." if fine else "The demo cannot run: see 'missing' above.")
    output.result({"demo": fine, "checks": [asdict(c) for c in checks]}, "\n".join(lines))
    return 0 if fine else FAILED


def _system() -> Check:
    found = f"{platform.python_version()} on {platform.platform()}"
    if sys.platform != "linux":
        return Check("Python", "missing", found, "hairstage runs on Linux: use one, or a container")
    return Check("Python", "ok", found)


def _kernels() -> Iterator[Check]:
    """libLLVM and libatomic, and the GPU, by running a kernel."""
    done = subprocess.run([sys.executable, "-c", KERNEL], capture_output=True, text=True)
    if done.returncode:
        said = done.stderr.strip().splitlines() or [f"ended with code {done.returncode}"]
        remedy = said[-1].partition(": run ")[2]
        remedy = f"run {remedy}" if remedy else "reinstall hairstage, or set DRJIT_LIBLLVM_PATH"
        name = "libatomic" if "libatomic" in said[-1] else "libLLVM"
        yield Check(name, "missing", said[-1].partition(": run ")[0], remedy)
        return
    variant, library, gpu = json.loads(done.stdout.splitlines()[-1])
    yield Check("libLLVM", "ok", f"{library}; kernels run with {variant}")
    yield Check("GPU", "ok", "NVIDIA, with its driver" if gpu else "none: jobs run on the CPU")


def _cores() -> Check:
    cores = usable_cores()
    return Check("cores", "ok" if cores > 1 else "limited", f"{cores}")


def memory_bytes() -> int:
    """Memory of this machine, or the limit of its container."""
    found = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with suppress(OSError, ValueError):
        found = min(found, int(Path("/sys/fs/cgroup/memory.max").read_text()))
    return found


def _memory(gb: float) -> Check:
    return _room("memory", f"{gb:.1f} GB", gb, (MEMORY_GB, QUICK_MEMORY_GB), "close programs")


def _disk(out: Path) -> Check:
    there = next(p for p in (out, *out.parents) if p.exists())
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        return Check("disk", "missing", f"{there} cannot be written", "name a folder with --out")
    gb = shutil.disk_usage(there).free / 1e9
    found = f"{gb:.1f} GB are free at {there}"
    return _room("disk", found, gb, (DISK_GB, QUICK_DISK_GB), "make room, or use --out")


def _room(name: str, found: str, gb: float, needed: tuple[float, float], todo: str) -> Check:
    full, quick = needed
    if gb >= full:
        return Check(name, "ok", found)
    if gb >= quick:
        return Check(name, "limited", found, f"enough for demo --quick; demo needs {full:g} GB")
    return Check(name, "missing", found, f"demo --quick needs {quick:g} GB: {todo}")


def _terminals() -> Check:
    """Pseudo-terminals and local ports, on which the simulated devices are."""
    try:
        for end in pty.openpty():
            os.close(end)
        socket.create_server(("127.0.0.1", 0)).close()
    except OSError as error:
        remedy = "mount /dev/pts and bring up the loopback interface"
        return Check("simulated rig", "missing", f"it cannot have devices: {error}", remedy)
    return Check("simulated rig", "ok", "pseudo-terminals and local ports")


def _port(port: int) -> Check:
    try:
        socket.create_server(("127.0.0.1", port)).close()
    except OSError as error:
        found = f"{port}: {error.strerror}"
        return Check("port", "limited", found, "stop what uses it, or 'hairstage serve --port'")
    return Check("port", "ok", f"{port} is free for 'hairstage serve'")


def _serial_ports(folder: Path) -> Iterator[Check]:
    """Those of real devices."""
    for port in sorted(folder.iterdir()) if folder.is_dir() else ():
        if os.access(port, os.R_OK | os.W_OK):
            yield Check("serial port", "ok", str(port))
        else:
            remedy = "adduser $USER dialout, then log in again"
            yield Check("serial port", "limited", f"{port} may not be opened", remedy)


def _extras() -> Iterator[Check]:
    for extra, (module, what) in EXTRAS.items():
        if find_spec(module) is None:
            remedy = f"pip install 'hairstage[{extra}]'"
            yield Check(extra, "limited", f"not installed: no {what}", remedy)
