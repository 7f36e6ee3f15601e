"""Files that were made to do harm: they end their own process at most, and take no memory here."""

from __future__ import annotations

import os
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import bombs
import cv2
import numpy as np
import pytest
from bombs import peak_mb
from waiting import gone, orphan, until

from appearance.model.light_sums import weights_of_environment
from reconstruction import Light
from reconstruction.files.exr import write_exr
from stage_service.decoding import Decoder, DecoderBusy, Undecodable, framing
from stage_service.decoding import decoder as side
from stage_service.decoding.limits import Limits

LIGHTS = [Light(n, np.array(p), np.ones(3)) for n, p in (("a", [1.0, 0, 0]), ("b", [-1.0, 0, 0]))]
MB = 1 << 20
SLOW = bombs.obj(900_000)
"""A head that takes seconds to read."""
MAP = cv2.imencode(".hdr", np.full((32, 64, 3), 0.5, np.float32))[1].tobytes()


@pytest.fixture
def decoder() -> Iterator[Decoder]:
    with closing(Decoder()) as decoder:
        yield decoder


def lit(decoder: Decoder, data: bytes, kind: str = "exr") -> np.ndarray:
    return decoder.map_weights(data, f"map.{kind}", kind, 0.0, LIGHTS)


def pid(decoder: Decoder) -> int:
    decoder.start()
    assert decoder._process is not None
    return decoder._process.pid


def forks(parent: int) -> list[int]:
    """The processes that `parent` has begun and that have not ended."""
    path = Path(f"/proc/{parent}/task/{parent}/children")
    return [int(word) for word in path.read_text().split()]


def test_a_process_that_is_still_starting_is_ended_at_once(monkeypatch, tmp_path):
    """On a busy machine it loads its libraries for longer than a service may take to stop."""
    slow = tmp_path / "python"
    slow.write_text("#!/bin/sh\nexec sleep 100\n")
    slow.chmod(0o755)
    monkeypatch.setattr(side.sys, "executable", str(slow))
    decoder = Decoder()
    decoder.warm_up()
    process = until(lambda: decoder._starting)
    closing_it = threading.Thread(target=decoder.close)
    closing_it.start()
    closing_it.join(30)
    assert not closing_it.is_alive()
    assert gone(process.pid)
    with pytest.raises(DecoderBusy, match="stopping"):
        decoder.start()


@pytest.mark.parametrize(
    ("data", "kind", "size"),
    [
        (bombs.exr(8000, 4000), "exr", "8000 × 4000"),
        (bombs.exr(64, 16, claimed=(60000, 60000)), "exr", "60000 × 60000"),
        (bombs.radiance(20000, 10000), "hdr", "20000 × 10000"),
    ],
)
def test_a_map_that_unpacks_to_gigabytes_is_refused_by_its_header(decoder, data, kind, size):
    decoder.start()

    def refused() -> None:
        with pytest.raises(Undecodable) as error:
            lit(decoder, data, kind)
        expected = f"map.{kind}: the image unpacks to {size} pixels; at most 8,388,608 are read"
        assert str(error.value) == expected

    assert peak_mb(refused) < 30


def test_a_map_is_read_as_it_was_in_the_service_itself(decoder, tmp_path):
    image = np.random.default_rng(0).random((32, 64, 3)).astype(np.float32)
    write_exr(tmp_path / "map.exr", image)
    expected = weights_of_environment(LIGHTS, image, 30.0)
    data = (tmp_path / "map.exr").read_bytes()
    np.testing.assert_array_equal(decoder.map_weights(data, "m", "exr", 30.0, LIGHTS), expected)


def test_a_file_that_needs_more_memory_than_its_limit_is_refused(decoder, tmp_path):
    file = tmp_path / "zeros.exr"
    file.write_bytes(bombs.exr(4096, 2048))
    decoder.frames.limits = Limits(64 * MB)
    with pytest.raises(Undecodable) as error:
        decoder.preview(file, size=64)
    assert str(error.value) == f"{file}: needs more than 0.0625 GiB of memory: it is not read"
    decoder.frames.limits = side.FRAMES
    assert decoder.preview(file, size=64), "and the next one is read"


@pytest.mark.parametrize(
    ("limits", "why"),
    [
        (Limits(1 << 30, cpu_s=1), "takes more than 1 s of processor time"),
        (Limits(1 << 30, wall_s=0.3), "takes more than 0.3 s"),
    ],
)
def test_a_file_that_takes_longer_than_its_limit_is_refused(decoder, limits, why):
    process = pid(decoder)
    decoder.given.limits = limits
    with pytest.raises(Undecodable) as error:
        decoder.head(SLOW, "head.obj")
    assert str(error.value) == f"head.obj: {why}: it is not read"
    until(lambda: not forks(process))


def test_a_decoder_that_dies_is_named_and_the_next_file_has_another(decoder):
    process, reported = pid(decoder), []

    def read() -> None:
        with pytest.raises(Undecodable) as error:
            decoder.head(SLOW, "head.obj")
        reported.append(str(error.value))

    for victim, number in ((lambda: forks(process), signal.SIGSEGV), (lambda: [process], 9)):
        thread = threading.Thread(target=read)
        thread.start()
        until(lambda: forks(process))
        for one in victim():
            os.kill(one, number)
        thread.join()
    assert reported[0].startswith("head.obj: decoding it crashed")
    assert reported[0].endswith("SIGSEGV")
    assert reported[1].startswith("head.obj: decoding it crashed")
    assert len(decoder.head(bombs.obj(2), "head.obj").faces) == 2


def test_it_has_nothing_of_the_service_but_its_own_connection(decoder, monkeypatch):
    monkeypatch.setenv("HAIRSTAGE_DATABASE", "postgresql://user:secret@host")
    with socket.create_server(("127.0.0.1", 0)) as listener:
        os.set_inheritable(listener.fileno(), True)
        process = pid(decoder)
        kinds = [str(f.readlink()).split(":")[0] for f in Path(f"/proc/{process}/fd").iterdir()]
        assert kinds.count("socket") == 1
        assert set(kinds) <= {"/dev/null", "socket", "pipe", "anon_inode"}
    assert b"secret" not in Path(f"/proc/{process}/environ").read_bytes()
    status = Path(f"/proc/{process}/status").read_text()
    assert "NoNewPrivs:\t1" in status
    assert Path(f"/proc/{process}/oom_score_adj").read_text().strip() == "1000"
    lower = os.getpriority(os.PRIO_PROCESS, process)
    assert lower > os.getpriority(os.PRIO_PROCESS, 0)


def test_it_ends_with_the_service_that_is_killed_whatever_it_is_at(tmp_path):
    code = """
import sys, threading, time
from pathlib import Path
from stage_service.decoding import Decoder

decoder = Decoder()
decoder.start()
data = b"v 0 0 0\\nv 0 1 0\\nv 1 0 0\\n" + b"f 1 2 3\\n" * 900_000
threading.Thread(target=decoder.head, args=(data, "head.obj"), daemon=True).start()
path = Path(f"/proc/{decoder._process.pid}/task/{decoder._process.pid}/children")
while not (fork := path.read_text().strip()):
    time.sleep(0.01)
(Path(sys.argv[1]) / "fork").write_text(fork)
print(decoder._process.pid, flush=True)
time.sleep(600)
"""
    process = orphan(code, tmp_path)
    until(lambda: gone(process))
    until(lambda: gone(int((tmp_path / "fork").read_text())))


def test_requests_to_a_full_decoder_are_refused_at_once(decoder, monkeypatch):
    monkeypatch.setattr(side, "WAIT_S", 0.05)
    with decoder.given.place():
        with pytest.raises(DecoderBusy, match=r"0\.05 s"):
            decoder.head(bombs.obj(1), "head.obj")
        lane = side.Lane(0, 0, side.GIVEN)
        with pytest.raises(DecoderBusy, match="too many"), lane.place():
            pass
        decoder.maps.limits = side.GIVEN
        assert lit(decoder, MAP, "hdr").shape == (2, 3), "maps do not wait for heads"


def test_nothing_is_begun_after_the_end(decoder):
    process = pid(decoder)
    decoder.close()
    assert gone(process)
    with pytest.raises(DecoderBusy, match="stopping"):
        decoder.head(bombs.obj(1), "head.obj")


@pytest.mark.parametrize(
    ("reported", "parts"),
    [
        ({"dtype": "|O", "shape": [1, 3]}, [bytearray(24)]),
        ({"dtype": "<f8", "shape": [1, 4]}, [bytearray(32)]),
        ({"dtype": "<f8", "shape": [2, 3]}, [bytearray(24)]),
        ({"dtype": "<f8", "shape": [-1, 3]}, [bytearray(24)]),
        ({"dtype": "<f8", "shape": "13"}, [bytearray(24)]),
        ({"shape": [1, 3]}, [bytearray(24)]),
        ({"dtype": "<f8", "shape": [1, 3]}, []),
    ],
)
def test_results_that_are_no_arrays_of_the_expected_kind_are_refused(reported, parts):
    with pytest.raises(Undecodable, match="no valid arrays"):
        side._arrays("a", {"arrays": [reported]}, parts, [("<f8", (None, 3))])
    fine = {"arrays": [{"dtype": "<f8", "shape": [1, 3]}]}
    assert side._arrays("a", fine, [bytearray(24)], [("<f8", (None, 3))])[0].shape == (1, 3)


def test_a_result_that_is_too_large_is_not_read():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        framing.send(theirs, {}, [bytes(100)])
        with pytest.raises(ValueError, match="at most 99"):
            framing.receive(ours, 99)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        theirs.sendall(b"\xff\xff\xff\xff")
        with pytest.raises(ValueError, match="at most"):
            framing.receive(ours, 99)
        theirs.close()
        with pytest.raises(EOFError):
            framing.receive(ours, 99)


def test_missing_and_invalid_frames_raise_different_errors(decoder, tmp_path):
    with pytest.raises(FileNotFoundError):
        decoder.preview(tmp_path / "gone.exr")
    (tmp_path / "none.exr").write_bytes(b"none")
    with pytest.raises(Undecodable, match=str(tmp_path / "none.exr")):
        decoder.preview(tmp_path / "none.exr")
    (tmp_path / "bomb.exr").write_bytes(bombs.exr(64, 16, claimed=(60000, 60000)))
    with pytest.raises(Undecodable, match="at most 160,000,000 are read"):
        decoder.figures(tmp_path / "bomb.exr")
    os.mkfifo(tmp_path / "pipe.exr")
    with pytest.raises(Undecodable, match="no plain file"):
        decoder.preview(tmp_path / "pipe.exr")
    write_exr(tmp_path / "frame.exr", np.ones((4, 6, 3), np.float32))
    assert decoder.figures(tmp_path / "frame.exr")["width"] == 6
