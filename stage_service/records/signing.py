"""Signed texts of a root folder."""

from __future__ import annotations

import hashlib
import hmac
import json
import logging
import secrets
import threading
from base64 import urlsafe_b64decode, urlsafe_b64encode
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from reconstruction.containment import plain_file
from stage_service.background import beside
from stage_service.records.polled_file import PolledFile
from stage_service.records.tokens import write_secret

log = logging.getLogger("hairstage.logins")
KEY_FILE = "login.key"
KEY_BYTES = 32
"""The size of SHA-256; a longer key adds nothing."""
LOOK_S = 1.0
"""Interval at which the file is checked."""
LONGEST_TEXT = 4096
"""Longest signed text, in characters."""


class SigningKey:
    """A secret in `path` (mode 0600) that signs texts (HMAC-SHA256).

    A key that is missing, damaged, or readable by other users is replaced at the start, which voids
    earlier texts. A key replaced by another process is used within `LOOK_S`; one that disappears,
    or is on a disk that hangs, stays in use. Without `path`, or until the disk accepts it, the key
    lasts as long as the process.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._path = path
        self._key = secrets.token_bytes(KEY_BYTES)
        self._stored = path is None
        self._storing: Future[None] | None = None
        self._lock = threading.Lock()
        self._file: PolledFile[bytes] | None = None
        if path is None:
            return
        try:
            self._key, self._stored = _read(path), True
        except FileNotFoundError:
            self._store()
        except (OSError, ValueError) as error:
            log.warning("%s: logins and blackout rights begin anew: %s", path, error)
            self._store()
        self._file = PolledFile(path, self._newest, self._key, wait_s=0.0, every_s=LOOK_S)

    def sign(self, purpose: str, data: dict[str, Any]) -> str:
        """`data` as a URL-safe text, valid for this purpose alone."""
        with self._lock:
            if not self._stored and (self._storing is None or self._storing.done()):
                self._storing = beside(self._store, KEY_FILE)
        payload = _encoded(json.dumps(data, separators=(",", ":")).encode())
        return f"{payload}.{_encoded(self._mac(purpose, payload))}"

    def verify(self, purpose: str, text: str) -> dict[str, Any] | None:
        """The data that was signed for this purpose; None for any other text."""
        payload, _, mac = text.partition(".")
        if len(text) > LONGEST_TEXT or not text.isascii():
            return None
        if not hmac.compare_digest(_encoded(self._mac(purpose, payload)), mac):
            return None
        data: dict[str, Any] = json.loads(urlsafe_b64decode(payload + "=" * (-len(payload) % 4)))
        return data

    def _mac(self, purpose: str, payload: str) -> bytes:
        key = self._key if self._file is None else self._file.value
        # Neither has a line break, so no two pairs make the same text.
        return hmac.digest(key, f"{purpose}\n{payload}".encode(), hashlib.sha256)

    def _newest(self) -> bytes:
        """Read the file's key; the present one if it has none."""
        assert self._path is not None
        try:
            self._key, self._stored = _read(self._path), True
        except (OSError, ValueError) as error:
            log.warning("%s: the present key stays in use: %s", self._path, error)
        return self._key

    def _store(self) -> None:
        assert self._path is not None
        try:
            write_key(self._path, self._key)
        except OSError as error:
            log.warning("%s: logins last until this service ends: %s", self._path, error)
        else:
            self._stored = True


def write_key(path: Path, key: bytes | None = None) -> None:
    """Replace the key at `path`, which voids texts signed with the old one. Raises `OSError`."""
    write_secret(path, (secrets.token_bytes(KEY_BYTES) if key is None else key).hex() + "\n")


def _read(path: Path) -> bytes:
    """Raises `OSError`, and `ValueError` for a key that is damaged or that others could read."""
    file = plain_file(path, most=1000)
    mode = file.stat().st_mode & 0o777
    if mode & 0o077:
        file.chmod(0o600)
        if not file.stat().st_mode & 0o077:  # else the disk has no modes
            raise ValueError(f"other users could read it (mode {mode:o})")
    key = bytes.fromhex(file.read_text("ascii").strip())
    if len(key) != KEY_BYTES:
        raise ValueError(f"it holds {len(key)} bytes; a key has {KEY_BYTES}")
    return key


def _encoded(data: bytes) -> str:
    return urlsafe_b64encode(data).rstrip(b"=").decode()
