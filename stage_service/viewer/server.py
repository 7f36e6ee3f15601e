"""The tracer's process: runs each call on its own thread."""

from __future__ import annotations

import os
import socket
import sys
import threading
from contextlib import suppress
from pathlib import Path

from stage_service.decoding import framing
from stage_service.viewer.operations import OPERATIONS, Source
from stage_service.viewer.tracer import KINDS
from stage_service.viewer.viewing import Cache

LOWEST = 19
"""The lowest priority, so that captures come first."""
MOST_REQUEST = 1 << 20


def main(control: socket.socket) -> None:
    """Serve the calls that come over `control`, until that is closed."""
    os.nice(LOWEST)
    with suppress(OSError):  # without memory the kernel ends this process first
        Path("/proc/self/oom_score_adj").write_text("1000")
    models = Cache(Source.open)
    control.send(b"ready")
    while True:
        message, fds, _, _ = socket.recv_fds(control, 16, 1)
        if not message:
            os._exit(0)  # at once: the parent waits for it
        for fd in fds:
            threading.Thread(target=_serve, args=(socket.socket(fileno=fd), models)).start()


def _serve(connection: socket.socket, models: Cache) -> None:
    with connection, suppress(OSError, EOFError):
        request, _ = framing.receive(connection, MOST_REQUEST)
        source = Source(Path(request["model"]), tuple(map(Path, request["captures"])))
        try:
            found = OPERATIONS[request["operation"]](models.get(source), **request["options"])
        except Exception as error:
            kind = next((k for k, e in KINDS.items() if isinstance(error, e)), "fault")
            text = str(error) if kind in KINDS else f"{type(error).__name__}: {error}"
            framing.send(connection, {"kind": kind, "error": text})
            return
        if isinstance(found, bytes):
            framing.send(connection, {}, [found])
        else:
            framing.send(connection, {"result": found})


if __name__ == "__main__":
    main(socket.socket(fileno=int(sys.argv[1])))
