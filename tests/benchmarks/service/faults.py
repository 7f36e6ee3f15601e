"""Load x fault: a blackout in each, the frames it cost, and whether the capture is finished."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
from postgresql import Missing, running
from standing import PLACES

from benchmarks.command import LeftOut
from benchmarks.service.live import HURRY_S, LOADS, Live
from reconstruction import Capture, Progress, verify
from stage_service.cli.support.children import Children
from stage_service.config import RigFile

LIGHTS = [f"light_{i:03d}" for i in range(60)]
RATE_HZ = 10.0
DISK = 800 << 20
Strike = Callable[[Live], AbstractContextManager[object]]
"""What goes wrong, in the block."""
HEAD = ("fault", "load", "dark after, s", "said", "frames lost", "of", "capture")


@dataclass(frozen=True)
class Cell:
    """A fault under a load: `seconds` until a blackout was answered (of a service that is killed:
    until the lamps were dark), as `state`; `lost` of the `kept` frames that the journal had then;
    how the capture `ended` when it was asked to go on afterwards, or why this was not tried."""

    fault: str
    load: str
    seconds: float | None = None
    state: str = ""
    lost: int = 0
    kept: int = 0
    ended: str = ""

    def row(self) -> tuple[object, ...]:
        """As `HEAD` has it."""
        seconds = "" if self.seconds is None else f"{self.seconds:.2f}"
        return (self.fault, self.load, seconds, self.state, self.lost, self.kept, self.ended)


def cells(
    rig: RigFile, children: Children, folder: Path, progress: Progress, *, quick: bool
) -> Iterator[Cell]:
    """Every fault under every load; of the 13 places of a SIGKILL each under the next load."""
    faults, loads = list(FAULTS.items()), list(LOADS)
    places = PLACES[:1] if quick else PLACES
    if quick:
        faults, loads = faults[:2], loads[:1]
    for number, (fault, setting) in enumerate(faults):
        try:
            with setting(folder) as (command, strike):
                live = Live(rig, children, folder / f"root-{number}", command)
                for load in loads:
                    progress(f"{fault}, {load}", 0.1 * number)
                    yield _black_out(live, fault, load, strike)
                live.end()
        except LeftOut as error:
            yield Cell(fault, "", ended=f"not tried: {error}")
    for number, place in enumerate(places):
        progress(f"SIGKILL: {place[0]}", 0.7 + 0.3 * number / len(places))
        yield _kill(rig, children, folder / f"killed-{number}", place, loads[number % len(loads)])


def _black_out(live: Live, fault: str, load: str, strike: Strike) -> Cell:
    plan = {"lights": LIGHTS, "projectors": [], "stepping": "software"}
    # A second service takes a while to start: the capture is to run when it asks for the stage.
    rate = 1.0 if fault == SECOND else RATE_HZ
    with LOADS[load](live):
        capture = live.call("POST", "/captures", {"plan": {**plan, "rate_hz": rate}})
        while live.call("GET", f"/captures/{capture['id']}")["frames_written"] < 5:
            time.sleep(0.02)
        with strike(live):
            begin = time.monotonic()
            state = live.call("POST", "/devices/blackout")["state"]
            seconds = time.monotonic() - begin
    return Cell(fault, load, seconds, state, *_finish(live, capture["id"], capture["path"]))


def _finish(live: Live, capture: str, path: str) -> tuple[int, int, str]:
    """Lost frames of those that there are, how many those are, and how the capture ends."""
    here = Path(f"/proc/{live.child.pid}/root{Path(path).resolve()}")
    status = live.until_done(capture)
    kept = _sums(here)
    for _ in range(3):
        if status["outcome"] == "completed":
            break
        _resume(live, capture)
        status = live.until_done(capture)
    now, wrong = _sums(here), verify(here)
    ended = status["outcome"] if not wrong else f"{status['outcome']}, but {wrong[0]}"
    return sum(now.get(key) != sum_ for key, sum_ in kept.items()), len(kept), ended


def _resume(live: Live, capture: str) -> None:
    """Let it go on, once all is dark: a blackout that was answered late still goes on, and latches
    again, or refuses captures, until it is over."""
    deadline = time.monotonic() + HURRY_S
    while True:
        if live.call("POST", "/devices/blackout")["state"] == "dark":
            response = live.http.request("POST", f"/captures/{capture}/resume", json={})
            if response.status_code != httpx.codes.CONFLICT:
                response.raise_for_status()
                return
        assert time.monotonic() < deadline, f"{capture} was never let go on"
        time.sleep(0.5)


def _sums(path: Path) -> dict[tuple[int, str], str | None]:
    """Each frame's checksum, as the journal has it."""
    return {k: r.sha256 for k, r in Capture(path).records.items() if r.file is not None}


def _kill(
    rig: RigFile, children: Children, folder: Path, place: tuple[str, str, int, str], load: str
) -> Cell:
    """SIGKILL at that place: the watchdog darkens, or the next service, whichever is first."""
    name, function, call, stepping = place
    (folder / "signs").mkdir(parents=True)
    module = [sys.executable, "-m", "benchmarks.service.standing_service"]
    live = Live(
        rig, children, folder / "root", [*module, str(folder / "signs"), function, str(call)]
    )
    plan = {"lights": LIGHTS[:10], "rows": {"last": 9}, "stepping": stepping}
    with LOADS[load](live):
        (folder / "signs" / "armed").touch()
        capture = live.call("POST", "/captures", {"plan": plan})
        deadline = time.monotonic() + HURRY_S
        while not (folder / "signs" / "here").exists():
            assert time.monotonic() < deadline, f"it never came to: {name}"
            time.sleep(0.01)
        live.kill()
    begin = time.monotonic()
    while _lit(rig):
        time.sleep(0.01)
    seconds = time.monotonic() - begin
    live.begin()
    if not Path(capture["path"], "plan.json").exists():
        ended = (0, 0, "nothing of it was there yet")
    else:
        ended = _finish(live, capture["id"], capture["path"])
    live.end()
    return Cell(f"SIGKILL: {name}", load, seconds, "lamps dark", *ended)


def _lit(rig: RigFile) -> int:
    """How many lamps the light bank says are lit (register 1), asked beside the service."""
    assert rig.devices is not None
    with socket.create_connection(("127.0.0.1", int(rig.devices.lights.port)), 5) as link:
        link.sendall(struct.pack(">HHHBBHH", 7, 0, 6, 1, 4, 1, 1))
        lit: int = struct.unpack(">HHHBBBH", link.recv(11, socket.MSG_WAITALL))[-1]
    return lit


@contextmanager
def _nothing(_live: Live) -> Iterator[None]:
    yield


@contextmanager
def _plain(_folder: Path) -> Iterator[tuple[list[str], Strike]]:
    yield [], _nothing


@contextmanager
def _database(_folder: Path) -> Iterator[tuple[list[str], Strike]]:
    """PostgreSQL, stopped at once while many ask for jobs."""
    with ExitStack() as stack:
        try:
            server = stack.enter_context(running())
        except Missing as error:
            raise LeftOut(str(error)) from error

        @contextmanager
        def strike(live: Live) -> Iterator[None]:
            server.stop()
            with ExitStack() as links:
                for _ in range(45):
                    address = (live.http.base_url.host, live.http.base_url.port or 80)
                    links.enter_context(socket.create_connection(address)).sendall(
                        live.request("/jobs")
                    )
                try:
                    yield
                finally:
                    server.start()

        yield [*_ENV, f"HAIRSTAGE_DATABASE_URL={server.url}", *_OWN], strike


@contextmanager
def _disk(folder: Path) -> Iterator[tuple[list[str], Strike]]:
    """A file system of the service's own, filled to the last byte."""
    root = folder / f"root-{list(FAULTS).index('disk full')}"
    root.mkdir()
    mount = f'mount -t tmpfs -o size={DISK} tmpfs "$0" && exec "$@"'
    command = ["unshare", "--map-root-user", "--mount", "sh", "-c", mount, str(root)]
    if subprocess.run([*command, "true"], capture_output=True, check=False).returncode:
        raise LeftOut("no file system of our own can be mounted here")

    @contextmanager
    def strike(live: Live) -> Iterator[None]:
        filler = Path(f"/proc/{live.child.pid}/root{root.resolve()}", "filler")
        with filler.open("wb") as file:
            try:
                while True:
                    file.write(bytes(1 << 20))
                    file.flush()
            except OSError:
                pass
        time.sleep(0.3)
        yield
        filler.unlink()

    yield [*command, *_OWN], strike


@contextmanager
def _hung(_folder: Path) -> Iterator[tuple[list[str], Strike]]:
    """Every device, the light bank among them, stands still until the blackout was answered."""

    @contextmanager
    def strike(live: Live) -> Iterator[None]:
        devices = live.stage_pid()
        os.kill(devices, signal.SIGSTOP)
        try:
            yield
        finally:
            os.kill(devices, signal.SIGCONT)

    yield [], strike


@contextmanager
def _clock(folder: Path) -> Iterator[tuple[list[str], Strike]]:
    """The time of day jumps by thirty days, and back by sixty."""
    shim, ahead = folder / "clock.so", folder / "ahead"
    if shutil.which("cc") is None:
        raise LeftOut("no C compiler here")
    source = Path(__file__).with_name("clock.c")
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", shim, source], check=True)
    ahead.write_text("0")

    @contextmanager
    def strike(_live: Live) -> Iterator[None]:
        ahead.write_text(f"{30 * 86400}")
        time.sleep(0.3)
        yield
        ahead.write_text(f"{-30 * 86400}")

    yield [*_ENV, f"LD_PRELOAD={shim}", f"CLOCK_AHEAD={ahead}", *_OWN], strike


@contextmanager
def _second(folder: Path) -> Iterator[tuple[list[str], Strike]]:
    """Another service asks for the stage, and is refused, while a capture runs."""

    @contextmanager
    def strike(live: Live) -> Iterator[None]:
        command = [*_OWN, *live.words(folder / "second")]
        done = subprocess.run(command, capture_output=True, text=True, timeout=HURRY_S, check=False)
        assert done.returncode, "the second service took the stage"
        assert live.call("GET", "/health")["capture"], "the capture had ended already"
        yield

    yield [], strike


_ENV = ["env"]
_OWN = [sys.executable, "-m", "stage_service.cli"]
SECOND = "a second service"
FAULTS: dict[str, Callable[[Path], AbstractContextManager[tuple[list[str], Strike]]]] = {
    "none": _plain,
    "clock jumps": _clock,
    "PostgreSQL down": _database,
    "disk full": _disk,
    "all devices hang": _hung,
    SECOND: _second,
}
