"""Client of the service's HTTP API."""

from __future__ import annotations

import getpass
import os
import socket
import ssl
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Self

import httpx

from reconstruction import Progress
from reconstruction.files.durable import writing
from stage_service.cli.support.commands import (
    BAD_INPUT,
    FAILED,
    UNREACHABLE,
    CommandError,
    in_url,
)
from stage_service.records.tokens import own_file, own_token

DEFAULT_URL = "http://127.0.0.1:8331"
LEASE = "Hairstage-Lease"
ATTEMPTS = 5
"""How often a download is begun or resumed."""
LEASE_S = 120.0
"""Seconds of a lease; a command that dies blocks the stage for no longer."""


class ServiceClient:
    """A connection to a running service, a context manager. Problems are raised as `CommandError`.

    `lease` is the token of the lease under which it steers.
    """

    def __init__(self, url: str | None = None, lease: str | None = None) -> None:
        self.url = url or os.environ.get("HAIRSTAGE_URL") or DEFAULT_URL
        unix = self.url.removeprefix("unix:") if self.url.startswith("unix:") else None
        authority = os.environ.get("HAIRSTAGE_CA")
        known: ssl.SSLContext | bool = True
        if authority:
            known = ssl.create_default_context(cafile=authority)
        elif not self.url.startswith("https:"):  # all authorities take 0.1 s to read
            known = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        self._http = httpx.Client(
            base_url=self.url if unix is None else "http://localhost",
            transport=httpx.HTTPTransport(uds=unix, verify=known),
            timeout=60.0,
            trust_env=False,
        )
        local = unix is not None or self._http.base_url.host in ("127.0.0.1", "localhost", "::1")
        if token := os.environ.get("HAIRSTAGE_TOKEN") or (_own() if local else None):
            self._http.headers["Authorization"] = f"Bearer {token}"
        self._steer_with(lease)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._http.close()

    def get(self, path: str) -> Any:
        """The JSON at `path`."""
        return self.request("GET", path)

    def all(self, path: str, most: int = 1000) -> list[list[Any]]:
        """The list at `path` in pages of `most`, the newest page first."""
        pages: list[list[Any]] = []
        while not pages or len(pages[-1]) == most:
            pages.append(self.get(f"{path}?limit={most}&offset={most * len(pages)}"))
        return pages

    def post(self, path: str, body: Any = None) -> Any:
        """Post `body`; returns the response's JSON."""
        return self.request("POST", path, json=body)

    def request(self, method: str, path: str, **more: Any) -> Any:
        """Send one request; returns the response's JSON. Raises `CommandError`."""
        try:
            response = self._http.request(method, path, **more)
        except httpx.TransportError as error:
            raise CommandError(
                f"no service responds at {self.url} ({error}): start one with 'hairstage serve', "
                "or "
                "name its URL with --url or HAIRSTAGE_URL",
                UNREACHABLE,
                "Unreachable",
            ) from error
        if response.is_success:
            return _json(response)
        raise _problem(response)

    def download(self, path: str, out: Path, progress: Progress) -> int:
        """Write the bytes at `path` to the file `out`, all or none; returns their number.

        Resumes by ranges after a broken connection. Raises `CommandError`.
        """
        etag = None
        with writing(out) as temporary, temporary.open("wb") as file:
            for _ in range(ATTEMPTS):
                more: dict[str, str] = (
                    {"Range": f"bytes={file.tell()}-", "If-Range": etag} if etag else {}
                )
                try:
                    with self._http.stream("GET", path, headers=more) as response:
                        if not response.is_success:
                            response.read()
                            raise _problem(response)
                        if response.status_code != 206:  # the first attempt, or the file changed
                            file.seek(0)
                            file.truncate()
                        etag = response.headers["etag"]
                        size = file.tell() + int(response.headers["content-length"])
                        for data in response.iter_bytes():
                            file.write(data)
                            progress(f"{file.tell():,} of {size:,} bytes", file.tell() / size)
                        return file.tell()
                except httpx.TransportError as error:
                    broke = error
            raise CommandError(f"{self.url}{path} broke off: {broke}", UNREACHABLE, "Unreachable")

    @contextmanager
    def leased(self) -> Iterator[Callable[[], None]]:
        """Hold the lease until the end of the block; call the yielded function every minute.

        Does nothing if this client already has a lease.
        """
        if LEASE in self._http.headers:
            yield lambda: None
            return
        granted = self.post("/lease", {"holder": me(), "seconds": LEASE_S})
        self._steer_with(granted["token"])
        renewed = time.monotonic()

        def renew() -> None:
            nonlocal renewed
            if time.monotonic() - renewed > LEASE_S / 4:
                self.request("PATCH", "/lease", json={"seconds": LEASE_S})
                renewed = time.monotonic()

        try:
            yield renew
        finally:
            with suppress(CommandError):  # it has expired, or the service has gone
                self.request("DELETE", "/lease")
            self._steer_with(None)

    def _steer_with(self, token: str | None) -> None:
        if token is None:
            self._http.headers.pop(LEASE, None)
        else:
            self._http.headers[LEASE] = token

    def follow_capture(
        self, capture: str, progress: Progress, check: Callable[[], None] = lambda: None
    ) -> dict[str, Any]:
        """Poll a capture until it is done; `check` may raise to give up waiting."""

        return self.follow(f"/captures/{capture}", lambda s: progress(*capture_progress(s)), check)

    def follow_job(
        self, job: str, progress: Progress, check: Callable[[], None] = lambda: None
    ) -> dict[str, Any]:
        """Poll a job until it is done; `check` may raise to give up waiting."""

        return self.follow(f"/jobs/{in_url(job)}", lambda s: progress(*job_progress(s)), check)

    def follow(
        self,
        path: str,
        show: Callable[[dict[str, Any]], None],
        check: Callable[[], None],
        until: Callable[[dict[str, Any]], bool] = lambda _: False,
    ) -> dict[str, Any]:
        """Poll the capture or job at `path` until it is done, or `until` its status; returns that.

        `show` gets every status; `check` may raise to give up waiting.
        """
        while True:
            status: dict[str, Any] = self.get(path)
            show(status)
            if status["state"] == "done" or until(status):
                return status
            check()
            time.sleep(0.3)


def capture_progress(status: dict[str, Any]) -> tuple[str, float]:
    """What a capture does, in words with the time left, and the share of its time that passed."""
    running, planned = status["progress"], status["frames_planned"]
    if running is None:
        done = status["frames_written"]
        return f"{status['state']}, {done:,} of {planned:,} frames", done / max(planned, 1)
    left = running["seconds_left"]
    time_left = "" if left is None else f", {time_text(left)} left"
    return f"{capture_work(status)}{time_left}", running["share"]


def capture_work(status: dict[str, Any]) -> str:
    """What a capture does, and the frames that have arrived."""
    running, planned = status["progress"], status["frames_planned"]
    done = status["frames_written"] if running is None else sum(running["frames"].values())
    frames = f"{done:,} of {planned:,} frames"
    if running is None or (waiting := running["waiting"]) is None:
        return f"{status['state']}, {frames}"
    first, *others = waiting["cameras"]
    more = f" and {len(others)} more" if others else ""
    doing = waiting["doing"] or f"waiting for {first}{more}"
    return f"{doing}, {waiting['seconds']} s; {frames}"


def job_progress(status: dict[str, Any]) -> tuple[str, float]:
    """The step of a job in words, and the share of the job that is done."""
    p = status["progress"]
    return (status["state"], 0.0) if p is None else (f"{p['step']}: {p['what']}", p["share"])


def time_text(seconds: float) -> str:
    """A duration, to the precision of an estimate."""
    if seconds >= 5400:
        return f"{seconds / 3600:.1f} h"
    if seconds >= 90:
        return f"{seconds / 60:.0f} min"
    return f"{seconds:.0f} s"


def _problem(response: httpx.Response) -> CommandError:
    problem = _json(response)
    code = BAD_INPUT if response.status_code in (404, 422) else FAILED
    return CommandError(
        f"{problem['title']}: {problem['detail']}", code, "Problem", problem=problem
    )


def _json(response: httpx.Response) -> Any:
    try:
        data = response.json()
        if response.is_success or "title" in data:
            return data
    except (ValueError, TypeError):
        pass
    raise CommandError(
        f"{response.url} returned {response.status_code}, and no document of hairstage: check "
        "--url "
        "and HAIRSTAGE_URL",
        UNREACHABLE,
        "Unreachable",
    )


def _own() -> str | None:
    """This user's token, which is sent to services of this machine alone."""
    try:
        return own_token() if own_file().exists() else None
    except OSError:
        return None


def me() -> str:
    """This user and machine, as the holder of a lease."""
    try:
        user = getpass.getuser()
    except (OSError, KeyError):  # a container's user may have no name
        user = f"user {os.getuid()}"
    return f"{user} on {socket.gethostname()}"
