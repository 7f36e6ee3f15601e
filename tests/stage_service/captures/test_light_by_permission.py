"""No lamp goes on unless a person has permitted it since the last start, blackout, abort or hold.

A machine of rules starts, stops and kills services on one tiny stage, and lets two people, the
disk, the bank and the clock do what they do. What may be lit is the test's own account (`Rights`),
kept by what people have requested, and compared with the light bank at the moment that a lamp goes
on there. Nothing that the service reports adds to it.

A kill is modelled in this process: the wires of the dead service are cut, so that nothing it still
sends arrives, the next service gets a copy of the root folder as it was then, and the bank's
watchdog puts its lamps off. A power cut also takes back the names of files that were renamed last
and not flushed.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    rule,
    run_state_machine_as_test,
)
from waiting import until

from reconstruction import CaptureError
from stage_service.captures import capture_queue
from stage_service.captures.capture_queue import CaptureQueue, UnknownEntry
from stage_service.captures.catalogue import UnknownCapture
from stage_service.captures.control import Caller
from stage_service.config import RigFile, SafetyLimits
from stage_service.device_config import LightRegisters
from stage_service.devices.cameras import link
from stage_service.jobs.follower import JobFollower
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.resolved import PlanError
from stage_service.records import clock
from stage_service.records.lease import NoLease
from stage_service.service import Service
from stage_service.service_models import (
    AcknowledgeRequest,
    CaptureRequest,
    LeaseRequest,
    QueueRequest,
    RenewRequest,
    SnapshotRequest,
)

REFUSALS = (RuntimeError, OSError, UnknownEntry, UnknownCapture, NoLease, PlanError, CaptureError)
STALLS = st.sampled_from([None, None, "pulse", "frames"])
PEOPLE = st.sampled_from(["Ada", "Eve"])
CONSENT = "N. N., 3 May 2026, flashes of 14 Hz for one second"
RETRIES = 1
UNFLUSHED = ("queue.json", "shooting", "captures.index")
"""Files of the root folder that are renamed into place and whose folder is not flushed."""
HOUR = 3600.0


@dataclass
class Wanted:
    """A capture of one lamp that nothing else lights: that lamp alone says whose light it is."""

    lamp: int
    steps: int
    flashes: bool

    @property
    def plan(self) -> CapturePlan:
        """Its steps differ by 1 % in exposure; six of 50 ms flash at about 14 Hz."""
        return CapturePlan(
            lights=(f"light_{self.lamp:03d}",),
            projectors=(),
            sentinels=False,
            stepping="software",
            retries=RETRIES,
            brackets=tuple(1.0 + 0.01 * i for i in range(self.steps)),
            exposure={"olat": 0.05 if self.flashes else 0.002},
            consent=CONSENT if self.flashes else None,
        )


class Rights:
    """What people have permitted, by lamp; `put_on` is called by the bank as lamps go on."""

    def __init__(self, root: Callable[[], Path]) -> None:
        self.lock = threading.RLock()
        self.root = root
        self.left: Counter[int] = Counter()  # lights that are permitted still
        self.made: Counter[int] = Counter()
        self.armed: dict[int, str] = {}
        self.waiting: dict[int, Wanted] = {}
        self.released = False  # somebody has read why the queue was held
        self.leased: tuple[str, float, float, float] | None = None  # who, ends: boot, wall; granted
        self.known: set[str] = set()  # captures that were there when it was released
        self.wrong: list[str] = []

    def put_on(self, lamps: set[Any]) -> None:
        with self.lock:
            lamp = next(iter(lamps))
            if len(lamps) > 1 or not isinstance(lamp, int):
                self.wrong.append(f"{len(lamps)} lamps or projectors were put on")
                return
            self.made[lamp] += 1
            if self.left[lamp] <= 0 and (problem := self._begin(lamp)) is not None:
                self.wrong.append(f"lamp {lamp} was put on: {problem}")
                return
            self.left[lamp] -= 1
            if (name := self.armed.get(lamp)) is not None and not self._on_record(name):
                self.wrong.append(f"lamp {lamp} flashed before its arming was on the disk")

    def _begin(self, lamp: int) -> str | None:
        """Take it that the queue begins with this lamp; why it may not."""
        wanted = self.waiting.get(lamp)
        if wanted is None:
            return "nobody had permitted it"
        if not self.released:
            return "the queue was held, and nobody had released it"
        if self.leased is not None:
            return f"{self.leased[0]} had the lease"
        if wanted.flashes:
            return "it flashes, and nobody had armed it"
        for folder in (self.root() / "captures").iterdir():
            manifest = folder / "manifest.json"
            if folder.name not in self.known and manifest.is_file():
                outcome = json.loads(manifest.read_text())["outcome"]
                if outcome != "completed":
                    return f"capture {folder.name} had ended as {outcome}"
        del self.waiting[lamp]
        self.left[lamp] = wanted.steps * (1 + RETRIES)
        return None

    def _on_record(self, name: str) -> bool:
        text = (self.root() / "audit.jsonl").read_text()
        return any("flash.armed" in line and name in line for line in text.splitlines())

    def permit(self, wanted: Wanted, armed_by: str | None = None) -> None:
        with self.lock:
            self.left[wanted.lamp] = wanted.steps * (1 + RETRIES)
            self.armed.pop(wanted.lamp, None)
            if armed_by is not None:
                self.armed[wanted.lamp] = armed_by

    def withdraw(self) -> None:
        """Nothing is permitted any more."""
        with self.lock:
            self.left.clear()
            self.released = False


class Clock:
    """`time` for the service's clocks: hours pass, and the wall clock is set, when the test says
    so."""

    def __init__(self) -> None:
        self.passed = self.set_by = 0.0

    def wall(self) -> float:
        return time.time() + self.passed + self.set_by

    def boot(self) -> float:
        return time.clock_gettime(time.CLOCK_BOOTTIME) + self.passed

    def as_module(self) -> Any:
        return SimpleNamespace(
            time=self.wall,
            monotonic=lambda: time.monotonic() + self.passed,
            clock_gettime=lambda _: self.boot(),
            CLOCK_BOOTTIME=0,
            CLOCK_MONOTONIC=0,
        )


class Disk:
    """Fails each flush below `root` with the error number `fault`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.fault: int | None = None
        self.root = Path("/nowhere")
        fsync = os.fsync

        def flush(handle: int) -> None:
            there = str(Path(f"/proc/self/fd/{handle}").readlink())
            if self.fault is not None and there.startswith(str(self.root)):
                raise OSError(self.fault, os.strerror(self.fault))
            fsync(handle)

        monkeypatch.setattr(os, "fsync", flush)


class Stage(RuleBasedStateMachine):
    """One stage, the services on it, one after the other, and who is about it."""

    wire: Callable[..., Any]
    new_world: Callable[[], Any]
    folder: Path
    disk: Disk
    clock: Clock
    looks: Counter[CaptureQueue]
    done: Counter[str]

    @initialize(reads_back=st.sampled_from([True, True, False]), waiting=st.integers(1, 3))
    def install(self, reads_back: bool, waiting: int) -> None:
        self.world, self.reads_back = self.new_world(), reads_back
        self.lamps = iter(range(200))
        self.wanted: dict[str, Wanted] = {}  # by an entry's or a capture's id
        self.tokens: dict[str, str | None] = {"Ada": None, "Eve": None}
        self.read: tuple[str, int] | None = None
        self.happened = 0  # reasons to hold the queue
        self.paused: tuple[int, int] | None = None
        self.stall: str | None = None
        self.earlier: dict[str, bytes | None] = {}
        self.now: dict[str, bytes | None] = {}
        self.root = self.folder / f"{len(list(self.folder.iterdir()))}"
        self.root.mkdir()
        self.rights = Rights(lambda: self.root)
        self.world.put_on = self.rights.put_on
        self.start()
        for _ in range(waiting):
            self.add("Ada", flashes=False, place=0)

    def teardown(self) -> None:
        if hasattr(self, "service"):
            self.done["lights"] += sum(self.rights.made.values())
            self.disk.fault = None
            self.let_go()
            self.service.close()
            self.wires.cut()

    # The service.

    def start(self) -> None:
        self.done["starts"] += 1
        self.withdraw()
        self.disk.root = self.root
        self.wires = self.wire(self.world, lights=0.2, trigger=60.0)
        self.service = Service(self.rig_file(self.wires.rig_file), self.root)
        self.service.start()
        until(lambda: self.service.unread == 0 and self.line._thread.is_alive())
        self.settle()

    def rig_file(self, wired: RigFile) -> RigFile:
        rig_file = replace(wired, safety=SafetyLimits(living_subject=True))
        if self.reads_back:
            return rig_file
        assert rig_file.devices is not None
        over = {"registers": LightRegisters(lit=None), "accept_unverified_blackout": True}
        lights = rig_file.devices.lights.model_copy(update=over)
        return replace(rig_file, devices=rig_file.devices.model_copy(update={"lights": lights}))

    @property
    def line(self) -> CaptureQueue:
        return self.service.queue._queue

    @property
    def captures(self) -> Any:
        return self.service._captures

    def by(self, person: str) -> Caller:
        return Caller(person, self.tokens[person], person, moment=self.service.moment())

    def withdraw(self) -> None:
        """Nothing is permitted from here on, and what was read is no longer the newest."""
        self.happened += 1
        self.paused = None
        self.rights.withdraw()

    def settle(self) -> None:
        """Until nothing moves by itself: no capture runs, or it is paused, or stalled by the test,
        and the queue's thread has looked twice since."""
        line = self.line
        while True:
            until(self.is_still)
            running, looks = self.captures.running, self.looks[line]
            until(lambda n=looks: self.looks[line] >= n + 2 or not line._thread.is_alive())
            if self.is_still() and self.captures.running == running:
                break
        with self.rights.lock:  # what the service reports takes away, and gives nothing
            if running is None:
                self.rights.left.clear()
                self.paused = None
            view = self.service.queue.view()
            self.rights.released &= view.hold is None
            there = [self.wanted[e.id] for e in view.waiting if e.id in self.wanted]
            self.rights.waiting = {w.lamp: w for w in there}
        self.earlier, self.now = self.now, self.small_files()

    def is_still(self) -> bool:
        captures = self.captures
        if captures.running is None:
            return captures._preparing is None
        if captures.running_state == "paused":
            return True
        if self.stall == "pulse":
            return bool(self.world.pulses_held)
        if self.stall == "frames":
            before, run = self.world.busy.get("cam_0", 0), captures._running
            until(lambda: captures._running is not run or self.world.busy["cam_0"] < before - 1)
            return captures._running is run
        return False

    def small_files(self) -> dict[str, bytes | None]:
        paths = {name: self.root / name for name in UNFLUSHED}
        return {n: p.read_bytes() if p.is_file() else None for n, p in paths.items()}

    def attempt(self, work: Callable[[], Any]) -> Any:
        """What `work` returns; None where it is refused."""
        try:
            result = work()
        except REFUSALS as error:
            self.done[f"refused: {type(error).__name__}"] += 1
            return None
        return True if result is None else result

    def lit_by(self, wanted: Wanted, work: Callable[[], Any], armed_by: str | None = None) -> Any:
        """`work`, which a person does to have this lit; it may be lit only where it is accepted."""
        before = self.rights.made[wanted.lamp]
        self.rights.permit(wanted, armed_by)
        result = self.attempt(work)
        if result is None:
            with self.rights.lock:
                self.rights.left[wanted.lamp] = 0
                self.rights.armed.pop(wanted.lamp, None)
                assert self.rights.made[wanted.lamp] == before, (
                    "it was refused, and lit all the same"
                )
        if wanted.flashes and armed_by is None:
            assert result is None, "it flashes, and nobody has armed it"
        return result

    def refused_to(self, person: str, result: Any) -> None:
        """While somebody else has the lease."""
        leased = self.rights.leased
        assert result is None or leased is None or leased[0] == person, f"{leased} was ignored"

    def new(self, flashes: bool) -> Wanted:
        return Wanted(next(self.lamps), 6 if flashes else 3, flashes)

    # People.

    @rule(person=PEOPLE, flashes=st.booleans(), armed=st.booleans(), stall=STALLS)
    def capture(self, person: str, flashes: bool, armed: bool, stall: str | None) -> None:
        if self.captures.running is None:
            self.stall_at(stall)
        wanted = self.new(flashes)
        name = f"{person} {wanted.lamp}" if armed else None
        request = CaptureRequest(plan=wanted.plan, armed_by=name)
        by = self.by(person)
        made = self.lit_by(wanted, lambda: self.service.start_capture(request, by), name)
        self.refused_to(person, made)
        if made is not None:
            self.wanted[made.id] = wanted
        self.settle()

    @rule(person=PEOPLE)
    def snapshot(self, person: str) -> None:
        wanted = Wanted(next(self.lamps), 1, flashes=False)
        request, by = SnapshotRequest(light=f"light_{wanted.lamp:03d}"), self.by(person)
        made = self.lit_by(wanted, lambda: self.service.snapshot(request, by))
        self.refused_to(person, made)
        self.wanted["snapshot"] = wanted
        self.settle()

    @rule(person=PEOPLE, which=st.integers(0, 9), armed=st.booleans())
    def go_on_with(self, person: str, which: int, armed: bool) -> None:
        """Shoot what a capture lacks that did not complete."""
        short = [c for c in self.captures.list() if c.state == "done" and c.outcome != "completed"]
        if not short:
            return
        status = short[which % len(short)]
        wanted = self.wanted[status.request.get("queue", status.id)]
        name = f"{person} {wanted.lamp} {self.happened}" if armed else None
        by = self.by(person)
        made = self.lit_by(wanted, lambda: self.service.resume(status.id, by, name), name)
        self.refused_to(person, made)
        self.settle()

    @rule(person=PEOPLE, action=st.sampled_from(["pause", "resume", "abort"]), stall=STALLS)
    def steer(self, person: str, action: str, stall: str | None) -> None:
        """What runs, or what is started for it."""
        if self.captures.running is None:
            self.capture(person, flashes=False, armed=False, stall=stall or "frames")
        if self.captures.running is not None:
            getattr(self, action)(person, self.captures.running)
        self.settle()

    def pause(self, person: str, run: str) -> None:
        lamp, by = self.lamp_of(run), self.by(person)
        with self.rights.lock:
            left, self.rights.left[lamp] = self.rights.left[lamp], 0
        made = self.attempt(lambda: self.service.pause(run, by))
        self.refused_to(person, made)
        if made is None:
            self.rights.left[lamp] = left
        else:
            self.paused = (lamp, left)

    def resume(self, person: str, run: str) -> None:
        lamp, left = self.paused or (0, 0)
        by = self.by(person)
        with self.rights.lock:
            self.rights.left[lamp] += left
        made = self.attempt(lambda: self.service.resume(run, by))
        self.refused_to(person, made)
        if made is None:
            self.rights.left[lamp] -= left
        else:
            self.paused = None

    def abort(self, person: str, run: str) -> None:
        self.withdraw()
        assert self.attempt(lambda: self.service.abort(run, self.by(person))) is not None

    def lamp_of(self, run: str) -> int:
        queued = self.captures.get(run).request.get("queue", run)
        return self.wanted[queued].lamp

    @rule(person=PEOPLE)
    def blackout(self, person: str) -> None:
        self.withdraw()
        response = self.service.blackout(self.by(person))
        if response["state"] == "dark":
            assert not self.world.lit
            assert self.world.show == "OFF"
        if not self.reads_back:
            self.acknowledge(person)
        self.settle()

    def acknowledge(self, person: str) -> None:
        request = AcknowledgeRequest(name=person, note="all lamps are off")
        made = self.attempt(lambda: self.service.acknowledge(request, self.by(person)))
        self.refused_to(person, made)

    # The queue.

    @rule(person=PEOPLE, flashes=st.sampled_from([False, False, True]), place=st.integers(0, 3))
    def add(self, person: str, flashes: bool, place: int) -> None:
        wanted = self.new(flashes)
        with self.rights.lock:
            self.rights.waiting[wanted.lamp] = wanted
        request = QueueRequest(plan=wanted.plan, place=place)
        entry = self.attempt(lambda: self.service.queue.add(request, self.by(person)))
        if entry is not None:
            self.wanted[entry.id] = wanted
        self.settle()

    @rule(person=PEOPLE, which=st.integers(0, 9), place=st.sampled_from([None, 0, 1, 3]))
    def move_or_remove(self, person: str, which: int, place: int | None) -> None:
        entry, by, queue = self.entry(which), self.by(person), self.service.queue
        if entry is None:
            return self.skip()
        if place is None:
            self.attempt(lambda: queue.remove(entry, by))
        else:
            self.attempt(lambda: queue.move(entry, place, by))
        self.settle()

    @rule(person=PEOPLE, which=st.integers(0, 9), armed=st.booleans())
    def start_entry(self, person: str, which: int, armed: bool) -> None:
        entry, by = self.entry(which), self.by(person)
        if entry is None:
            return self.skip()
        wanted = self.wanted[entry]
        name = f"{person} {wanted.lamp} {self.happened}" if armed else None
        with self.rights.lock:
            self.rights.waiting.pop(wanted.lamp, None)
        made = self.lit_by(wanted, lambda: self.service.queue.start_one(entry, by, name), name)
        self.refused_to(person, made)
        self.settle()

    def entry(self, which: int) -> str | None:
        waiting = self.service.queue.view().waiting
        return str(waiting[which % len(waiting)].id) if waiting else None

    def skip(self) -> None:
        """No step. As a precondition it would depend on timing, which hypothesis does not take."""
        self.done["steps"] -= 1

    @rule(person=PEOPLE, action=st.sampled_from(["hold", "read", "release", "release late"]))
    def queue(self, person: str, action: str) -> None:
        """Hold it; read why it is held; release it, by what is read at once or was before."""
        by, hold = self.by(person), self.service.queue.view().hold
        if action == "hold":
            self.happened += 1
            self.rights.released = False
            self.service.queue.hold_by(by)
        elif action == "read" and hold is not None:
            self.read = hold.id, self.happened
        elif action == "release" and hold is not None:
            self.release_queue(person, hold.id)
        elif action == "release late" and self.read is not None:
            read, happened = self.read
            if happened == self.happened:
                self.release_queue(person, read)
            elif hold is not None:
                made = self.attempt(lambda: self.service.queue.go_on(read, by))
                assert made is None, "released by somebody who had not read why it is held"
        self.settle()

    def release_queue(self, person: str, hold: str) -> None:
        with self.rights.lock:
            self.rights.released = True
            self.rights.known = {p.name for p in (self.root / "captures").iterdir()}
            begun = sum(self.rights.made.values())
        made = self.attempt(lambda: self.service.queue.go_on(hold, self.by(person)))
        self.refused_to(person, made)
        if made is None:
            self.rights.released = False
            assert sum(self.rights.made.values()) == begun
        else:
            self.done["releases"] += 1
        self.settle()

    # The lease.

    @rule(
        person=PEOPLE,
        action=st.sampled_from(["take", "take", "renew", "release"]),
        hours=st.sampled_from([0.1, 1.0, 24.0]),
    )
    def lease(self, person: str, action: str, hours: float) -> None:
        held = self.rights.leased
        mine, seconds, leasing = (
            held is not None and held[0] == person,
            hours * HOUR,
            self.service.leasing,
        )
        by, took = self.by(person), self.disk.fault is None
        if action == "take":
            request = LeaseRequest(holder=person, seconds=seconds)
            made = self.attempt(lambda: leasing.take(request, by))
            assert (made is not None) == (held is None and took)
        elif action == "renew":
            made = self.attempt(lambda: leasing.renew(RenewRequest(seconds=seconds), by))
            assert (made is not None) == (mine and took)
        else:
            if mine:  # it may end before the call returns
                self.rights.leased = None
            made = self.attempt(lambda: leasing.release(by))
            assert (made is not None) == mine, "after a restart, too"
            made = None
        if made is not None:
            self.tokens[person] = made.token
            ends = self.clock.boot() + seconds, self.clock.wall() + seconds
            self.rights.leased = (person, *ends, seconds)
        self.settle()

    # What happens to the service.

    def let_go(self) -> None:
        self.stall, self.world.busy = None, {}
        self.world.hold_pulses = False
        if self.world.pulses_held:
            self.world.pulses_held = 0
            self.wires.flush()

    @rule(
        how=st.sampled_from(["stop", "kill", "power cut"]),
        lost=st.sets(st.sampled_from(UNFLUSHED)),
    )
    def restart(self, how: str, lost: set[str]) -> None:
        """SIGTERM, SIGKILL, or a power cut of the service's machine: names that were `lost`, not
        flushed, are those of before then."""
        if how != "stop":
            lost = lost & self.earlier.keys() if how == "power cut" else set()
            self.killed({name: self.earlier[name] for name in lost})
            return
        self.disk.fault = None
        self.let_go()
        self.service.close()
        self.wires.cut()
        self.lease_over_a_restart()
        self.start()

    def killed(self, files: dict[str, bytes | None]) -> None:
        self.wires.cut()
        dead, old = self.service, self.root
        self.root = self.folder / f"{len(list(self.folder.iterdir()))}"
        shutil.copytree(old, self.root, ignore=shutil.ignore_patterns(".part-*"))
        for name, data in files.items():
            (self.root / name).unlink(missing_ok=True)
            if data is not None:
                (self.root / name).write_bytes(data)
        with self.world.lock:  # by its watchdog
            self.world.lit, self.world.show, self.world.armed = set(), "OFF", 0
        self.stall, self.world.busy = None, {}
        self.world.hold_pulses, self.world.pulses_held = False, 0
        self.disk.fault = None
        dead.close()  # its threads end; nothing that they send arrives
        self.lease_over_a_restart()
        self.start()

    def lease_over_a_restart(self) -> None:
        """Until it ends by the wall clock, and never for longer than it was granted for."""
        if self.rights.leased is not None:
            person, _, wall, granted = self.rights.leased
            left = min(wall - self.clock.wall(), granted)
            ends = self.clock.boot() + left, wall
            self.rights.leased = (person, *ends, granted) if left > 0 else None

    @rule(seconds=st.sampled_from([-9000.0, -60.0, 60.0, 9000.0]), still=st.booleans())
    def clock_jumps(self, seconds: float, still: bool) -> None:
        """The wall clock is set, by which a lease does not go until the next start; or the process
        is stopped, and continued: minutes or hours pass between two of its instructions."""
        self.happened += 1
        self.rights.released = False
        if still:
            self.withdraw()
            self.clock.passed += abs(seconds)
        else:
            self.clock.set_by += seconds
        until(lambda: self.service.queue.view().hold is not None)
        leased = self.rights.leased
        if leased is not None and leased[1] <= self.clock.boot():
            self.rights.leased = None
        self.settle()

    # What happens to the devices and the disk.

    @rule(what=st.sampled_from(["none", "none", "stuck", "mute", "unpowered", "full", "read-only"]))
    def trouble(self, what: str) -> None:
        """One at a time: lamps that cannot be put off, a bank that answers nothing, or was switched
        off and on, a disk that is full or takes nothing."""
        with self.world.lock:
            self.world.stuck_lamps, self.world.deaf_lights = what == "stuck", what == "mute"
            if what == "unpowered":
                self.world.lit, self.world.owner, self.world.armed = set(), [0] * 17, 0
                self.world.levels = [65535] * len(self.world.levels)
        if what == "unpowered":
            self.wires.drop_lights()
        self.disk.fault = {"full": errno.ENOSPC, "read-only": errno.EROFS}.get(what)
        self.settle()

    @rule()
    def go_through(self) -> None:
        """What stalls goes through."""
        if self.captures.running is None:
            return self.skip()
        self.let_go()
        self.settle()

    def stall_at(self, where: str | None) -> None:
        """Captures stop with their lamp lit, before the box answers a pulse, or with it put off,
        before the frames come, and stay there."""
        self.let_go()
        self.stall = where
        self.world.hold_pulses = where == "pulse"
        self.world.busy = {"cam_0": 10**9} if where == "frames" else {}

    @invariant()
    def nothing_was_lit_without_permission(self) -> None:
        self.done["steps"] += 1
        assert not getattr(self, "rights", None) or not self.rights.wrong, self.rights.wrong


def counted(
    work: Callable[[CaptureQueue], None], looks: Counter[CaptureQueue]
) -> Callable[[CaptureQueue], None]:
    def count(queue: CaptureQueue) -> None:
        try:
            work(queue)
        finally:
            looks[queue] += 1

    return count


def run(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    wire: Callable[..., Any],
    world: Any,
    *,
    examples: int,
    steps: int,
    derandomize: bool,
) -> Counter[str]:
    """What was done, in so many examples of so many steps."""
    monkeypatch.setattr(capture_queue, "POLL_S", 0.01)
    monkeypatch.setattr(link, "POLL_S", (0.001, 0.01))
    monkeypatch.setattr(JobFollower, "start", lambda _self: None)
    looks: Counter[CaptureQueue] = Counter()
    for name in ("_begin_the_next", "_save"):  # which keeps it from beginning where it fails
        monkeypatch.setattr(CaptureQueue, name, counted(getattr(CaptureQueue, name), looks))
    clocks = Clock()
    monkeypatch.setattr(clock, "time", clocks.as_module())
    (tmp_path / "roots").mkdir()
    tools = {
        "wire": staticmethod(wire),
        "new_world": type(world),
        "folder": tmp_path / "roots",
        "disk": Disk(monkeypatch),
        "clock": clocks,
        "looks": looks,
        "done": Counter(),
    }
    machine = type("StageOfThisTest", (Stage,), tools)
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=examples,
            stateful_step_count=steps,
            derandomize=derandomize,
            deadline=None,
            database=None,
        ),
    )
    done: Counter[str] = machine.done
    return done


def test_no_lamp_is_lit_without_permission(monkeypatch, tmp_path, wire, world):
    done = run(monkeypatch, tmp_path, wire, world, examples=60, steps=15, derandomize=True)
    assert done["steps"] >= 500
    assert done["lights"] > 0


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_no_lamp_is_lit_without_permission_in_ten_thousand_steps(
    monkeypatch, tmp_path, wire, world
):
    done = run(monkeypatch, tmp_path, wire, world, examples=560, steps=25, derandomize=False)
    print(dict(done))
    assert done["steps"] >= 10_000
    assert done["lights"] > 0
