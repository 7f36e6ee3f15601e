"""Who has logged in, and who may black out without: signed, so that nothing is stored of either."""

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
"""A login is good for a day's work at the stage."""
AHEAD_S = 300.0
"""A clock that was set back by no more than this leaves the logins that it makes younger than now;
by more it ends them."""
LOGOUTS_FILE = "logouts.json"
MOST_LOGOUTS = 50
"""Logouts that are kept of one token one by one; one more ends all logins of that token so far, so
that the file stays small whoever logs in and out."""
BLACKOUT = "blackout"
"""What the right to a blackout is signed for."""


class NotStored(OSError):
    """The disk did not take what has to outlast a restart."""


class Login(BaseModel):
    """What a cookie says, signed: whose token (its hash), begun when, good until when (ns since
    1970, UTC); `epoch` and `turn` are those of `Ended` at its begin."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    id: str = Field(default_factory=lambda: secrets.token_urlsafe(9))
    token: str
    begun: int
    until: int
    epoch: str
    turn: int


class Ended(BaseModel):
    """The logins that are over before they expire; no clock decides it, as clocks are set.

    `epoch` is that of all logins that are not over. Of each token's hash: its logins that have
    ended, with when they would have expired (ns since 1970, UTC); and the last `turn` whose logins
    are over altogether.
    """

    model_config = ConfigDict(extra="forbid")

    epoch: str
    turn: int
    logins: dict[str, dict[str, int]]
    turns: dict[str, int]

    def has(self, login: Login) -> bool:
        """Whether that login is over."""
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
    """Logins and blackout rights of the service of `root`; without one they end with the process.

    A login is a signed text: whose token (its hash), from when, until when, and for which host and
    port. Checking it takes no store, so no number of logins ends another. What it opens is what the
    token opens now. `end` is on the disk before it returns; while the file of logouts is missing or
    damaged at a start, all logins that were begun before are over.
    """

    def __init__(self, root: Path | None = None) -> None:
        self._key = SigningKey(None if root is None else root / KEY_FILE)
        self._file = None if root is None else root / LOGOUTS_FILE
        self._lock = threading.Lock()
        epoch = secrets.token_urlsafe(9)
        self._ended, self._stored = Ended(epoch=epoch, turn=0, logins={}, turns={}), False
        self._read()

    def begin(self, token: str, place: str) -> str:
        """Log in by a token, which was found good, at `place` (host and port); returns what the
        cookie is to hold."""
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
        """The hashes of the tokens that the good ones of these cookies stand for."""
        return [login.token for login in self._good(held, place)]

    def end(self, held: Iterable[str], place: str) -> None:
        """Log out: these cookies open nothing any more. Raises `NotStored` where a copy of them
        would open something again after a restart."""
        with self._lock:
            for login in self._good(held, place):
                self._ended.add(login, time.time_ns())
                self._stored = False
            if not self._stored:
                self._store()

    def blackout_right(self, name: str) -> str:
        """What a page keeps to darken the stage in this name, and for nothing else.

        It ends with the key, not with the login, the token or the time: darkness harms nobody, and
        whoever was once let in may find that somebody must be put in the dark at once.
        """
        return self._key.sign(BLACKOUT, {"name": name})

    def blackout_by(self, right: str) -> str | None:
        """In whose name this right darkens the stage."""
        data = self._key.verify(BLACKOUT, right)
        return None if data is None else str(data["name"])

    def _good(self, held: Iterable[str], place: str) -> list[Login]:
        now, good = time.time_ns(), []
        for text in held:
            data = self._key.verify(_at(place), text)
            with suppress(ValidationError):  # of another version of hairstage
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
                log.warning("%s: the logins until now are over: %s", self._file, error)
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
            try:  # without the file all of them are over at the next start; a full disk allows that
                self._file.unlink(missing_ok=True)
                flush(self._file.parent)
            except OSError:
                raise NotStored(
                    f"{self._file}: {error}. The login is over; a copy of its cookie would open "
                    "what its token opens once the service has been started again, for 12 hours "
                    "from the login: revoke the token, or mend the disk and log out again"
                ) from error


def _at(place: str) -> str:
    return f"login {place}"
