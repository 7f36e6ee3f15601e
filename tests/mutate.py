"""Reads files of a format, each damaged in another way, in a process of its own.

`python mutate.py FORMAT COUNT FOLDER` prints a line of JSON a file that was not read or refused as
it should be, and at the end one with what became of all. It is a process because a reader may end
it, hang, or take the machine's memory.
"""

from __future__ import annotations

import json
import re
import resource
import signal
import sys
from collections import Counter
from pathlib import Path

import numpy as np
from file_formats import FORMATS

SECONDS = 5
MOST_BYTES = 1 << 30
REFUSED = (ValueError, OSError)
WORDS = (b"-1", b"0", b"1e999", b"NaN", b"99999999999999999999", b"null", b'""', b"[]", b"{}", b"x")
"""In the place of numbers, where the file is text."""
INTERESTING = (b"\xff\xff\xff\xff", b"\x00\x00\x00\x80", b"\x7f\xff\xff\xff", b"\0" * 8, b"1e999")


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """`data` with some bytes flipped, cut, doubled, moved or replaced by what breaks sums."""
    out = bytearray(data)
    if data.isascii() and rng.random() < 0.5:
        numbers = list(re.finditer(rb"[-+.\deE]*\d", data)) or list(re.finditer(rb"\w+", data))
        where = numbers[rng.integers(len(numbers))]
        out[where.start() : where.end()] = WORDS[rng.integers(len(WORDS))]
        return bytes(out)
    for _ in range(rng.integers(1, 5)):
        at, n = int(rng.integers(len(out) + 1)), int(rng.integers(1, 40))
        match rng.integers(7):
            case 0:
                out[at : at + 1] = bytes([rng.integers(256)])
            case 1:
                del out[at:]
            case 2:
                del out[at : at + n]
            case 3:
                out[at:at] = out[at : at + n] * int(rng.integers(1, 200))
            case 4:
                value = INTERESTING[rng.integers(len(INTERESTING))]
                out[at : at + len(value)] = value
            case 5:
                out[at:at] = rng.bytes(n)
            case _:
                if at < len(out):
                    out[at] ^= 1 << int(rng.integers(8))
    return bytes(out)


def main(name: str, count: int, folder: Path) -> None:
    file, read = FORMATS[name](folder)
    whole, rng = file.read_bytes(), np.random.default_rng(len(name))
    read(file)  # whole, it is read

    def late(*_: object) -> None:
        raise TimeoutError(f"not within {SECONDS} s")

    signal.signal(signal.SIGALRM, late)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST_BYTES, used + MOST_BYTES))
    outcomes: Counter[str] = Counter()
    for number in range(count):
        file.write_bytes(bad := damaged(whole, rng))
        print(json.dumps({"at": number}), flush=True)
        signal.alarm(SECONDS)
        try:
            read(file)
            outcomes["read"] += 1
        except TimeoutError as error:
            print(json.dumps({"wrong": number, "why": str(error), "file": bad[:200].hex()}))
        except REFUSED:
            outcomes["refused"] += 1
        except BaseException as error:
            why = f"{type(error).__name__}: {error}"
            print(json.dumps({"wrong": number, "why": why[:300], "file": bad[:200].hex()}))
        finally:
            signal.alarm(0)
    # of this program: getrusage counts the process that started it, too
    status = Path("/proc/self/status").read_text()
    peak = 1024 * int(status.partition("VmHWM:")[2].split()[0])
    print(json.dumps({"outcomes": outcomes, "peak_bytes": peak}))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3]))
