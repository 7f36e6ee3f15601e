"""Steps and bytes a second of the acquisition, beside what wires and disk allow.

Leaves `acquisition.json`.
"""

from __future__ import annotations

import argparse
import json
import socket
import statistics
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.acquisition.writing import measure
from benchmarks.command import Benchmark
from benchmarks.results import save
from reconstruction import CaptureWriter, Progress, silent
from stage_service.acquisition.sequencer import Sequencer
from stage_service.cli.support.children import Children
from stage_service.config import RigFile, load_rig_file
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.permission import Permission
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.resolved import resolve
from stage_service.plan.stepping import period_s

LIGHTS, STEPS = 331, 150
BAUD = 115200
RTU_BITS = 11
"""Bits on the wire for a byte: start, 8 data, parity, stop."""
SIZES: tuple[dict[str, int], ...] = (
    {},
    {"width": 160, "height": 160, "cameras": 8, "steps": 40},
)
"""Frames that are written: a megapixel rig's, and the demonstration's."""
RTU_SILENCE_S = 1.75e-3
"""Between frames above 19200 baud (Modbus over serial line 1.02, 2.5.1.1)."""
DMX_S = (92e-6 + 12e-6) + (1 + LIGHTS) * 44e-6
"""Break, mark after break, start code and a slot for each lamp (ANSI E1.11)."""


@contextmanager
def simulated(rig: str) -> Iterator[RigFile]:
    """Run the simulated stage of a rig file's text, wires paced by their baud rates."""
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "rig.toml").write_text(rig)
        command = [sys.executable, "-m", "simulators", "--rig", str(folder / "rig.toml")]
        command += ["--state", str(folder), "--ports", "auto", "--spp", "1", "--paced"]
        with Children(folder / "logs") as children:
            children.ready("simulators", command, 120)
            yield load_rig_file(folder / "rig.toml", folder / "devices.toml")


def run(out: Path, *, quick: bool = False, progress: Progress = silent) -> dict[str, Any]:
    """Measure everything and write `out/acquisition.json`; returns what it holds."""
    result: dict[str, Any] = {"lights": [], "captures": [], "writing": []}
    for i, kind in enumerate(_LIMITS):
        progress(f"lights on {kind}", 0.1 * i)
        result["lights"].append(_lights(kind))
        save(out / "acquisition.json", result)
    for i, stepping in enumerate(() if quick else ("software", "hardware")):
        progress(f"captures, {stepping}-stepped", 0.3 + 0.2 * i)
        with TemporaryDirectory(dir=out) as folder:
            result["captures"].append(_capture(Path(folder), stepping))
        save(out / "acquisition.json", result)
    for i, size in enumerate(SIZES[1:] if quick else SIZES):
        progress("writing", 0.7 + 0.15 * i)
        with TemporaryDirectory(dir=out) as folder:
            result["writing"].append(measure(Path(folder), **size))
        save(out / "acquisition.json", result)
    return result


def _lights(kind: str) -> dict[str, Any]:
    """Steps of one lamp on and off again, each confirmed as the link allows."""
    permission = Permission.granted("a benchmark")
    with simulated(_rig(kind)) as rig_file, permission.used():
        lights = DeviceSet.of(rig_file).lights
        lights.connect()
        lights.set_level(1.0)
        seconds = []
        for i in range(STEPS):
            begin = time.perf_counter()
            lights.select(i)
            lights.off()
            seconds.append(time.perf_counter() - begin)
        lights.close()
    took, limit = statistics.median(seconds), _LIMITS[kind]()
    return {
        "link": kind,
        "steps_per_s": 1 / took,
        "limit_steps_per_s": 1 / limit,
        "share_of_limit": limit / took,
    }


def _rtu_limit() -> float:
    """On and off: a write and its echo (8 bytes each), a read of two registers (8 and 9)."""
    frames = 2 * (8, 8, 8, 9)
    return sum(n * RTU_BITS / BAUD + RTU_SILENCE_S for n in frames)


def _tcp_limit() -> float:
    """The same four exchanges on the loopback, with a peer that only echoes."""
    frames = 2 * (12, 12)
    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=_echo, args=(server,), daemon=True)
        thread.start()
        with socket.create_connection(server.getsockname()) as link:
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            seconds = []
            for _ in range(STEPS):
                begin = time.perf_counter()
                for n in frames:
                    link.sendall(bytes(n))
                    got = 0
                    while got < n:
                        got += len(link.recv(n - got))
                seconds.append(time.perf_counter() - begin)
        thread.join()
    return statistics.median(seconds)


def _echo(server: socket.socket) -> None:
    peer, _ = server.accept()
    with peer:
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        while data := peer.recv(64):
            peer.sendall(data)


_LIMITS: dict[str, Callable[[], float]] = {
    "modbus_tcp": _tcp_limit,
    "modbus_rtu": _rtu_limit,
    "dmx_enttec": lambda: 2 * DMX_S,
}
"""Seconds that the link needs for a step, at best."""


def _capture(out: Path, stepping: str) -> dict[str, Any]:
    """Captures of all lamps, the second of which finds every picture made already.

    `service_ms_per_step_median` is what a step takes beyond the calls to devices; the processor's
    time has the drivers' and the writer's work in it, on all threads.
    """
    with simulated(_rig("modbus_tcp")) as rig_file:
        requested = CapturePlan(stepping="hardware" if stepping == "hardware" else "software")
        plan = resolve(requested, rig_file)
        steps, cost = plan.steps, plan.cost
        for attempt in range(2):
            folder = out / str(attempt)
            writer = CaptureWriter.create(folder, rig_file.rig, {"steps": steps})
            permission = Permission.granted("a benchmark")
            sequencer = Sequencer(DeviceSet.of(rig_file), writer, plan, permission=permission)
            cpu = time.process_time()
            outcome = sequencer.run()
            cpu = time.process_time() - cpu
        manifest = json.loads((folder / "manifest.json").read_text())
        assert rig_file.devices is not None
        period = statistics.fmean(period_s(s, rig_file.devices, None) for s in steps)
    causes = manifest["seconds_by_cause"]
    return {
        "stepping": stepping,
        "outcome": outcome,
        "error": manifest["error"],
        "steps": len(steps),
        "cameras": len(rig_file.rig.cameras),
        "seconds": manifest["seconds"],
        "seconds_predicted": cost.seconds,
        "steps_per_s": len(steps) / manifest["seconds"],
        "limit_steps_per_s": 1 / period,
        "seconds_by_cause": causes,
        "service_cpu_ms_per_step": 1e3 * cpu / len(steps),
        "service_ms_per_step_median": 1e3 * (manifest["service_s_per_step_median"] or 0.0),
        "goal_ms": 1.0,
    }


def _rig(kind: str) -> str:
    """A rig of all lamps and two small cameras, so that rendering and writing take little."""
    port = 'port = "lights"' if kind != "modbus_tcp" else "port = 15020"
    cameras = "".join(
        f"""
[[cameras]]
name = "cam_{i}"
position = [{x}, -0.9, 0.1]
target = [0.0, 0.0, 0.0]
fov_deg = 22.0
width = 32
height = 32
"""
        for i, x in enumerate((-0.3, 0.3))
    )
    accept = "accept_unverified_blackout = true" if kind == "dmx_enttec" else ""
    return f"""
name = "bench"
[dome]
lights = {LIGHTS}
radius = 1.2
intensity = [8.0, 8.0, 8.0]
{cameras}
[devices]
hardware_stepping = true
[devices.lights]
kind = "{kind}"
{port}
{accept}
[devices.trigger]
port = "trigger"
[devices.cameras]
port = 15021
readout_s = 0.002
buffers = 400
[safety]
living_subject = false
[capture.exposure]
dark = 0.005
all_on = 0.005
olat = 0.005
"""


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    return run(args.out, quick=args.quick, progress=progress)


BENCHMARK = Benchmark(_bench)
