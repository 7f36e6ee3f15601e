"""The firmware's portable core on a clock of the test's own: wraparound, watchdog, garbage."""

from __future__ import annotations

import ctypes
import random
import subprocess

import pytest
from waiting import until

from stage_service.devices.trigger.interface import TableRow

INTERLOCK, ESTOP, PATTERN = 1, 2, 4
LIGHT, PROJECTOR, CAMERAS = 1, 2, 4
WRAP = 1 << 32


class Core:
    """The core as a library; `now` is microseconds, which wrap as the board's do."""

    def __init__(self, library, now):
        self.core, self.now, self.inputs = library, now, 0
        self.box = ctypes.create_string_buffer(1 << 18)  # more than a tb_box, which is 67 KB
        self.text = ctypes.create_string_buffer(97)
        library.tb_init(self.box)

    def feed(self, data):
        """All that it answers to these bytes."""
        out = b""
        for byte in data:
            length = self.core.tb_receive(self.box, self.now % WRAP, self.inputs, byte, self.text)
            assert length <= 97
            out += self.text.raw[:length]
        return out

    def send(self, line):
        return self.feed(line.encode() + b"\n").decode().removesuffix("\n")

    def poll(self):
        return self.core.tb_poll(self.box, self.now % WRAP, self.inputs)

    def run(self, microseconds, tick=5):
        """(when, outputs) at each change, polled every `tick` microseconds."""
        changes, last, start = [], self.poll(), self.now
        while self.now - start < microseconds:
            self.now += tick
            outputs = self.poll()
            if outputs != last:
                changes.append((self.now - start, outputs))
                last = outputs
        return changes

    def table(self, *rows):
        self.send(f"TABLE {len(rows)}")
        for i, row in enumerate(rows):
            assert self.send(f"ROW {i} {row}") == f"OK ROW {i}"
        assert self.send("ARM").startswith("OK ARM")
        assert self.send("GO") == "OK GO"


@pytest.fixture(scope="session")
def library(build_firmware):
    built = build_firmware("core.so", "-shared", "-fPIC", sources=())
    core = ctypes.CDLL(str(built))
    core.tb_receive.restype = ctypes.c_size_t
    core.tb_poll.restype = ctypes.c_uint32
    word = ctypes.c_uint32
    core.tb_receive.argtypes = [
        ctypes.c_void_p,
        word,
        word,
        ctypes.c_ubyte,
        ctypes.c_void_p,
    ]
    core.tb_poll.argtypes = [ctypes.c_void_p, word, word]
    return core


@pytest.fixture(params=[0, WRAP - 2500, WRAP - 1], ids=["at 0", "wraps in a step", "wraps at GO"])
def core(library, request):
    return Core(library, request.param)


def test_a_table_is_clocked_the_same_across_the_wrap(core):
    core.table("3 L 1000 500 4000", "1 - 0 50 0")
    expected = []
    for begin in (0, 4000, 8000):
        expected += [
            (begin, LIGHT),
            (begin + 1000, LIGHT | CAMERAS),
            (begin + 1100, LIGHT),
            (begin + 1500, 0),
        ]
    expected += [(12000, CAMERAS), (12050, 0)]
    changes = core.run(15000, tick=1)
    assert [outputs for _, outputs in changes] == [outputs for _, outputs in expected]
    for (at, _), (due, _) in zip(changes, expected, strict=True):
        assert due <= at <= due + 5  # a poll for each thing that is done
    assert core.send("SEQ?") == "SEQ done 4 4 -"
    assert core.send("COUNT?") == "COUNT 4"


def test_lateness_does_not_add_up(core):
    core.table("50 L 0 100 1000")
    # The trigger pulse is as long as the exposure, so the gate is open alone only before it.
    begun = [at for at, outputs in core.run(60_000, tick=37) if outputs == LIGHT]
    assert len(begun) == 50
    for i, at in enumerate(begun):
        assert i * 1000 <= at <= i * 1000 + 3 * 37


def test_the_watchdog_stops_the_table_across_the_wrap(core):
    assert core.send("WATCHDOG 100") == "OK WATCHDOG 100"
    core.table("1 L 0 10000000 0")
    core.run(99_000)
    assert core.send("SEQ?") == "SEQ running 0 1 -"
    core.run(99_000)
    core.feed(b"\xff\x00noise\nPULSE 0\n")  # refused: feeds nothing
    assert core.run(2_000)[-1][1] == 0
    assert core.send("SEQ?") == "SEQ stopped 0 1 watchdog"


def test_a_long_idle_time_is_no_lapse_of_the_watchdog(core):
    core.table("1 L 0 10 0")
    core.run(1000)
    core.now += WRAP // 2 + 12345  # 36 minutes without a request
    assert core.send("ARM").startswith("OK ARM 1 ")
    core.now += WRAP // 2
    assert core.send("GO") == "OK GO"
    core.run(1000)
    assert core.send("SEQ?") == "SEQ done 1 1 -"


def test_the_pattern_must_come_and_must_have_gone(core):
    core.table("2 P 10 10 0")
    assert core.run(99_000) == [(5, PROJECTOR)]
    core.inputs = PATTERN
    assert [outputs for _, outputs in core.run(1000)] == [
        PROJECTOR | CAMERAS,
        0,
    ]
    # It is still up: the gate stays closed, and the cameras do not fire into the old pattern.
    assert core.run(101_000) == []
    assert core.send("SEQ?") == "SEQ stopped 1 1 no-pattern"


def test_safety_inputs_close_the_gates_at_the_next_look(core):
    for line, reason in ((ESTOP, "estop"), (INTERLOCK, "interlock"), (3, "estop")):
        core.inputs = 0
        core.table("1 LP 0 10000000 0")
        core.inputs = PATTERN
        core.run(20)
        core.inputs = 0
        core.run(50)
        core.inputs = line
        assert core.poll() & (LIGHT | PROJECTOR) == 0
        assert core.send("SEQ?").endswith(f" {reason}")
        assert core.send("GO").startswith("ERR 4")
        assert core.send("PULSE 10").startswith("ERR 3")


def test_garbage_gets_a_bounded_reply_and_opens_no_gate(library):
    rng = random.Random(7)
    core = Core(library, 0)
    words = [b"TABLE 2", b"ROW 0 1 LP 0 1 0", b"ROW 1 9 L 1 1 1", b"ARM", b"SEQ?", b"STOP"]
    words += [b"PULSE 10", b"RESET", b"WATCHDOG 100", b"ID?", b"STATUS?"]
    for _ in range(3000):
        line = bytearray(rng.choice(words))
        for _ in range(rng.randrange(4)):
            place = rng.randrange(len(line) + 1)
            line[place : place + rng.randrange(2)] = rng.randbytes(rng.randrange(120) // 40)
        line = bytes(line).replace(b"GO", b"")
        replies = core.feed(line + b"\n")
        assert replies.count(b"\n") == line.count(b"\n") + 1
        for reply in replies.split(b"\n")[:-1]:
            assert reply.isascii()
            assert reply.split()[0] in {
                b"OK",
                b"ERR",
                b"SEQ",
                b"STATUS",
                b"COUNT",
                b"HAIRSTAGE-TRIGGER",
            }
        core.now += rng.randrange(5000)
        assert core.poll() & (LIGHT | PROJECTOR) == 0
    assert core.send("ID?") == "HAIRSTAGE-TRIGGER 2 4096"


def test_garbage_while_a_table_runs_leaves_no_gate_open(library):
    rng = random.Random(11)
    for _ in range(40):
        core = Core(library, rng.randrange(WRAP))
        core.send("WATCHDOG 100")
        core.table("5 LP 10 10 10", "2 L 0 1000 0")
        for _ in range(60):
            core.feed(rng.randbytes(rng.randrange(30)))
            core.inputs = rng.choice([0, PATTERN, PATTERN, ESTOP, INTERLOCK, 0])
            core.now += rng.randrange(3000)
            core.poll()
        core.inputs = 0
        core.run(250_000, tick=50)  # whatever it was doing: done, or stopped
        assert core.poll() == 0
        assert core.feed(b"\nSEQ?\n").split(b"\n")[-2].split()[1] in (b"done", b"stopped")


def test_the_sanitizers_find_nothing_in_garbage(firmware_host):
    rng = random.Random(3)
    data = rng.randbytes(200_000)
    data += b"".join(b"ROW " + rng.randbytes(rng.randrange(200)) + b"\n" for _ in range(1000))
    data += b" " * 5000 + b"\n" + b"1 " * 200 + b"\nTABLE 1\nROW 0 1 L 0 1 0\nARM\nGO\nSTOP\nID?\n"
    program = subprocess.run(
        [firmware_host, "-", str(WRAP - 1000)], input=data, capture_output=True, timeout=60
    )
    assert (program.returncode, program.stderr) == (0, b"")
    assert program.stdout.endswith(b"HAIRSTAGE-TRIGGER 2 4096\n")


def test_the_driver_crosses_the_wrap_on_a_real_clock(firmware):
    box = firmware(WRAP - 30_000)  # 30 ms after the start
    box.trigger.load_table([TableRow(10, "L", 0.001, 0.001, 0.01)], 1.0)
    box.trigger.go()
    until(lambda: box.trigger.progress().state == "done")
    assert box.trigger.progress().steps == 10
