"""A PostgreSQL server of Debian's packages, for as long as it is needed."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

BINARIES = sorted(Path("/usr/lib/postgresql").glob("*/bin"))


class Missing(RuntimeError):
    """It cannot be run here; the message says what to install."""


@dataclass(frozen=True)
class PostgreSQL:
    """A server with its data in `folder`, at the socket there."""

    folder: Path
    user: int | None

    @property
    def url(self) -> str:
        """Of a database that is made where there is none."""
        return f"postgresql://hairstage@/hairstage?host={self.folder}"

    def start(self) -> None:
        """Begin to answer."""
        options = f"-c listen_addresses= -c fsync=off -k {self.folder}"
        self._run("pg_ctl", "-w", "-l", str(self.folder / "log"), "-o", options, "start")

    def stop(self) -> None:
        """As in a power cut."""
        self._run("pg_ctl", "-w", "-m", "immediate", "stop")

    def freeze(self) -> None:
        """Let it take connections and requests, and do nothing, until `thaw`."""
        for process in self._processes():
            os.kill(process, signal.SIGSTOP)

    def thaw(self) -> None:
        """Let it go on."""
        for process in self._processes():
            os.kill(process, signal.SIGCONT)

    def _processes(self) -> list[int]:
        first = int((self.folder / "data" / "postmaster.pid").read_text().split()[0])
        children = Path(f"/proc/{first}/task/{first}/children").read_text().split()
        return [first, *map(int, children)]

    def make(self) -> None:
        """Its files."""
        self._run("initdb", "--no-sync", "-A", "trust", "-U", "hairstage")

    def _run(self, program: str, *arguments: str) -> None:
        command = [str(BINARIES[-1] / program), "-D", str(self.folder / "data"), *arguments]
        out = subprocess.DEVNULL
        subprocess.run(command, check=True, user=self.user, cwd=self.folder, stdout=out)


@contextmanager
def running() -> Iterator[PostgreSQL]:
    """A server that answers. Raises `Missing`."""
    if not BINARIES:
        raise Missing("no PostgreSQL here (apt-get install postgresql)")
    user = None
    if os.getuid() == 0:  # the server refuses to be run by root
        user = next((u.pw_uid for u in pwd.getpwall() if u.pw_name == "postgres"), None)
        if user is None:
            raise Missing("PostgreSQL is here without the user postgres, and not for root")
    folder = Path(tempfile.mkdtemp(prefix="hairstage-pg-"))
    if user is not None:
        os.chown(folder, user, -1)
    try:
        server = PostgreSQL(folder, user)
        server.make()
        server.start()
        try:
            yield server
        finally:
            server.stop()
    finally:
        shutil.rmtree(folder)
