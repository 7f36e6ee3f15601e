"""The decoder's process, which forks for each file.

Each fork has the libraries loaded, decodes one file under hard limits, and ends, so files share no
state and all memory is freed.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import resource
import selectors
import signal
import socket
import sys
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Any

from stage_service.decoding import framing
from stage_service.decoding.operations import OPERATIONS, preload

LOWER = 10
"""Added to the niceness of the service: lamps and frames come first."""
MOST_REQUEST = 64 << 20
"""Bytes of a file of a request: twice the service's limit."""
REQUEST_S = 60
"""Deadline for reading the request; then its own limits apply."""
NO_NEW_PRIVILEGES, SIGNAL_AT_PARENTS_DEATH = 38, 1  # linux/prctl.h
NO_MEMORY = re.compile(
    "bad_alloc|[Uu]nable to allocate|[Ff]ailed to allocate|Insufficient memory|file has 0 parts"
)
"""Messages of libraries without memory; the last is OpenEXR's."""
MEMORY_FILE, MOST_ERROR = re.compile(r"/proc/self/fd/\d+"), 1000
ENDED_BY = {signal.SIGXCPU: "processor", signal.SIGKILL: "memory", signal.SIGALRM: "clock"}
"""Limit by the signal that ended a fork; SIGKILL: the machine has no memory."""


def main(control: socket.socket) -> None:
    """Serve connections that arrive through `control`, until it is closed."""
    os.nice(LOWER)
    with suppress(OSError):  # without memory the kernel ends this process first
        Path("/proc/self/oom_score_adj").write_text("1000")
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _prctl(NO_NEW_PRIVILEGES, 1)
    preload()
    read, write = os.pipe()
    os.set_blocking(write, False)
    os.set_blocking(read, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    children: dict[int, socket.socket] = {}
    control.send(b"ready")
    with selectors.DefaultSelector() as selector:
        selector.register(control, selectors.EVENT_READ)
        selector.register(read, selectors.EVENT_READ)
        while True:
            selector.select()
            with suppress(BlockingIOError):
                os.read(read, 4096)
            _reap(children)
            with suppress(BlockingIOError):
                message, fds, _, _ = socket.recv_fds(control, 16, 1, socket.MSG_DONTWAIT)
                if not message:
                    break
                for fd in fds:
                    _begin(socket.socket(fileno=fd), control, children)
    for pid in children:
        os.kill(pid, signal.SIGKILL)
    os._exit(0)  # at once: the parent waits for it


def _begin(connection: socket.socket, control: socket.socket, children: dict[int, Any]) -> None:
    parent = os.getpid()
    try:
        pid = os.fork()
    except OSError as error:  # no process, no memory
        _send(connection, {"ended": f"no process: {error}"})
        connection.close()
        return
    if pid:
        children[pid] = connection  # to report how the fork ended
        return
    status = 1
    try:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        _prctl(SIGNAL_AT_PARENTS_DEATH, signal.SIGKILL)
        if os.getppid() != parent:  # the parent has died already
            return
        control.close()
        for other in children.values():
            other.close()
        _decode(connection)
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(status)


def _reap(children: dict[int, socket.socket]) -> None:
    while children:
        pid, status = os.waitpid(-1, os.WNOHANG)
        if not pid:
            return
        connection = children.pop(pid)
        if os.WIFSIGNALED(status):
            number = os.WTERMSIG(status)
            limit = ENDED_BY.get(signal.Signals(number))
            name = signal.Signals(number).name
            _send(connection, {"limit": limit} if limit else {"ended": name})
        elif status:
            code = os.waitstatus_to_exitcode(status)
            _send(connection, {"ended": f"exit code {code}"})
        connection.close()


def _send(connection: socket.socket, head: dict[str, Any]) -> None:
    """Send a message without waiting, if the other end is still open."""
    connection.setblocking(False)
    with suppress(OSError):
        framing.send(connection, head)


def _decode(connection: socket.socket) -> None:
    """In the fork: read the request and send the response."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)  # ends the fork even inside a library
    signal.alarm(REQUEST_S)
    request, parts = framing.receive(connection, MOST_REQUEST)
    _limit(*request["limits"])
    name, path = request["name"], request["path"]
    try:
        with _at_hand(path, parts) as file:
            head, data = OPERATIONS[request["operation"]](file, **request["options"])
    except Exception as error:
        head, data = _error(error, path, name), []
    framing.send(connection, head, data)


def _error(error: Exception, path: str | None, name: str) -> dict[str, Any]:
    """The response for an error, with the client's name of the file."""
    if isinstance(error, MemoryError) or NO_MEMORY.search(str(error)):
        return {"limit": "memory"}
    kind, text = type(error).__name__, str(error)
    if not isinstance(error, OSError | ValueError):
        text = f"{name}: {kind}: {text}"
    text = MEMORY_FILE.sub(lambda _: name, text) if path is None else text
    return {"error": text[:MOST_ERROR], "kind": kind}


@contextlib.contextmanager
def _at_hand(path: str | None, parts: list[bytearray]) -> Any:
    """The requested file; data of the request as a file in memory."""
    if path is not None:
        yield Path(path)
        return
    fd = os.memfd_create("given")
    try:
        with os.fdopen(os.dup(fd), "wb") as file:
            while parts:
                file.write(parts.pop(0))
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
        yield Path(f"/proc/self/fd/{fd}")
    finally:
        os.close(fd)


def _limit(memory: int, cpu_s: int, wall_s: float) -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + memory
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s + 1))
    signal.alarm(0)
    signal.setitimer(signal.ITIMER_REAL, wall_s)


def _prctl(option: int, value: int) -> None:
    ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


if __name__ == "__main__":
    main(socket.socket(fileno=int(sys.argv[1])))
