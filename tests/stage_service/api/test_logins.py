"""Logins that outlast the service, and the right to a blackout that outlasts them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from serving import refused, send

from stage_service.api.app import create_app
from stage_service.api.gate import Access
from stage_service.config import RigFile
from stage_service.records.logins import Logins
from stage_service.records.tokens import Tokens
from stage_service.service import Service

DARK = "POST /devices/blackout"
Ask = Callable[..., httpx.Response]


@pytest.fixture
def tokens(tmp_path: Path) -> Tokens:
    return Tokens(tmp_path / "root" / "tokens.json", own="mine")


@pytest.fixture
def started(rig_file: RigFile, tmp_path: Path, tokens: Tokens) -> Callable[..., Any]:
    """`with started() as ask`: a service of the root folder, as a start has it."""

    @contextmanager
    def start() -> Iterator[Ask]:
        root = tmp_path / "root"
        service = Service(rig_file, root)
        app = create_app(service, Access(tokens, logins=Logins(root)))
        service.take_stage()
        try:
            yield lambda what, headers=(), **more: send(app, what, dict(headers), **more)
        finally:
            service.close()

    return start


def log_in(ask: Ask, token: str = "mine", **headers: str) -> tuple[dict[str, str], str]:
    """The header with the cookie of a login, and the right to a blackout that came with it."""
    answer = ask("POST /login", headers, json={"token": token})
    assert answer.status_code == 200, answer.text
    cookie = answer.headers["set-cookie"].partition(";")[0]
    return {"Cookie": cookie}, answer.json()["blackout"]


def test_a_login_and_a_right_to_a_blackout_outlast_the_service(started, tokens, tmp_path):
    ada = tokens.make("ada", ("read", "steer"))
    with started() as ask:
        cookie, right = log_in(ask, ada)
        assert ask("GET /login", cookie).json()["blackout"] is not None
    assert (tmp_path / "root" / "login.key").stat().st_mode & 0o777 == 0o600
    with started() as ask:
        assert ask("GET /login", cookie).json()["name"] == "ada"
        assert ask(DARK, cookie).json()["state"] == "dark"
        assert ask(DARK, {"Hairstage-Blackout": right}).json()["state"] == "dark"
        last = ask("GET /audit", {"Authorization": "Bearer mine"}).json()[-1]
        assert (last["who"][:20], last["action"]) == ("ada, blackout right ", "blackout")
        tokens.revoke("ada")
        refused(ask("GET /login", cookie), "unauthorized", 401)
