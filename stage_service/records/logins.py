"""Logins and blackout rights: signed texts, of which the service stores none."""

from __future__ import annotations

import json
import logging
import secrets
import threading
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from reconstruction.files.durable import flush
from reconstruction.reading import read_json
from stage_service.records.signing import KEY_FILE, SigningKey
from stage_service.records.tokens import hashed, write_secret

log = logging.getLogger("hairstage.logins")
LASTS_S = 12 * 3600.0
"""Seconds that a login is valid: a working day."""
AHEAD_S = 300.0
"""Logins from the future are valid up to this many seconds, for a clock that was set back."""
LOGOUTS_FILE = "logouts.json"
MOST_LOGOUTS = 50
"""Logouts stored per token; one more ends all its logins so far, which bounds the file."""
BLACKOUT = "blackout"
"""The purpose of a signed blackout right."""


class NotStored(OSError):
    """A logout could not be stored."""


class Login(BaseModel):
    """The signed content of a cookie: the token's hash, begin and end (ns since 1970, UTC), and
    `epoch` and `turn` of `Ended` at its begin."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    id: str = Field(default_factory=lambda: secrets.token_urlsafe(9))
    token: str
    begun: int
    until: int
    epoch: str
    turn: int


class Ended(BaseModel):
    """The logins that ended before they expire, independent of clocks.

    Only logins of the present `epoch` are valid. By a token's hash: `logins` that have ended, with
    their expiry (ns since 1970, UTC), and the last of `turns` of which all logins have ended.
    """

    model_config = ConfigDict(extra="forbid")

    epoch: str
    turn: int
    logins: dict[str, dict[str, int]]
    turns: dict[str, int]

    def has(self, login: Login) -> bool:
        """Whether the login has ended."""
        if login.epoch != self.epoch or login.turn <= self.turns.get(login.token, -1):
            return True
        return login.id in self.logins.get(login.token, {})

    def add(self, login: Login, now: int) -> None:
        """End a login."""
        ended = {**self.logins.get(login.token, {}), login.id: login.until}
        if len(ended) > MOST_LOGOUTS:
            ended = {one: until for one, until in ended.items() if until > now}
        if len(ended) > MOST_LOGOUTS:
            ended = {}
            self.turns[login.token] = self.turn
            self.turn += 1
        self.logins[login.token] = ended


class Logins:
    """Logins and blackout rights of the service of `root`; without a root they end with the
    process.

    A login is signed for one token, host and port, and has the token's present scopes. Checking
    needs no store, so logins cannot evict each other. `end` stores a logout before it returns. If
    the file of logouts is missing or damaged at a start, all earlier logins have ended.
    """

    def __init__(self, root: Path | None = None) -> None:
        self._key = SigningKey(None if root is None else root / KEY_FILE)
        self._file = None if root is None else root / LOGOUTS_FILE
        self._lock = threading.Lock()
        epoch = secrets.token_urlsafe(9)
        self._ended, self._stored = Ended(epoch=epoch, turn=0, logins={}, turns={}), False
        self._read()

    def begin(self, token: str, place: str) -> str:
        """Log in by a valid token at `place` (host and port); returns the cookie's value."""
        now = time.time_ns()
        login = Login(
            token=hashed(token),
            begun=now,
            until=now + round(LASTS_S * 1e9),
            epoch=self._ended.epoch,
            turn=self._ended.turn,
        )
        return self._key.sign(_at(place), login.model_dump())

    def tokens_of(self, held: Iterable[str], place: str) -> list[str]:
        """The hashes of the tokens of the valid ones among these cookies."""
        return [login.token for login in self._good(held, place)]

    def end(self, held: Iterable[str], place: str) -> None:
        """End the logins of these cookies. Raises `NotStored` if copies of them would be valid
        again after a restart."""
        with self._lock:
            for login in self._good(held, place):
                self._ended.add(login, time.time_ns())
                self._stored = False
            if not self._stored:
                self._store()

    def blackout_right(self, name: str) -> str:
        """A text that allows a page to darken the stage in this name, and nothing else.

        It ends with the key, not with login, token or time: a person who was once logged in must
        always be able to put the lamps off.
        """
        return self._key.sign(BLACKOUT, {"name": name})

    def blackout_by(self, right: str) -> str | None:
        """The name in a valid blackout right; None for another text."""
        data = self._key.verify(BLACKOUT, right)
        return None if data is None else str(data["name"])

    def _good(self, held: Iterable[str], place: str) -> list[Login]:
        now, good = time.time_ns(), []
        for text in held:
            data = self._key.verify(_at(place), text)
            with suppress(ValidationError):  # of another version
                login = Login.model_validate(data)
                in_time = login.begun - AHEAD_S * 1e9 <= now < login.until
                if in_time and not self._ended.has(login):
                    good.append(login)
        return good

    def _read(self) -> None:
        if self._file is None:
            return
        try:
            self._ended, self._stored = Ended.model_validate(read_json(self._file)), True
        except (OSError, ValueError) as error:
            if not isinstance(error, FileNotFoundError):
                log.warning("%s: all earlier logins have ended: %s", self._file, error)
            with suppress(NotStored):
                self._store()

    def _store(self) -> None:
        """Raises `NotStored`."""
        if self._file is None:
            return
        try:
            write_secret(self._file, json.dumps(self._ended.model_dump()) + "\n")
            self._stored = True
        except OSError as error:
            log.warning("%s: not written: %s", self._file, error)
            try:  # without the file all logins end at the next start
                self._file.unlink(missing_ok=True)
                flush(self._file.parent)
            except OSError:
                raise NotStored(
                    f"{self._file}: {error}. The login has ended; a copy of its cookie is valid "
                    "again after a restart of the service, until 12 hours after the login: revoke "
                    "the token, or repair the disk and log out again"
                ) from error


def _at(place: str) -> str:
    return f"login {place}"
