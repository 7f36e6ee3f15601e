"""Which scope opens which route: decided for each of them, and kept to."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
from fastapi import FastAPI
from serving import refused, routes_of, send

from stage_service.api.app import create_app, create_viewer
from stage_service.api.gate import Access
from stage_service.api.scopes import ROUTES
from stage_service.config import RigFile
from stage_service.records.tokens import SCOPES, Tokens
from stage_service.service import Service
from stage_service.viewer import Viewing

OPEN = {"/", "/docs", "/docs/errors.md", "/favicon.ico", "/openapi.json", "/view"}
ANY = {
    "GET /login",
    "POST /logout",
    "POST /devices/blackout",
    "POST /captures/{capture}/abort",
    "POST /queue:hold",
}
LOOKS = "POST /plans:validate", "POST /view/models/"
OTHERS = {
    "POST /devices/acknowledge": {"arm"},
    "POST /jobs": {"jobs"},
    "DELETE /jobs/{job}": {"jobs"},
    "POST /calibration": {"jobs"},
    "PUT /view/models/{name}/environments/{file}": {"jobs", "steer"},
    "DELETE /models/{model}": {"admin"},
    "DELETE /trash": {"admin"},
    "POST /trash/{name}/restore": {"admin"},
    "DELETE /lease": {"admin", "steer"},
}


def expected(method: str, path: str) -> set[str] | None:
    """One of which a token needs, as docs/how-to/safety.md has it; None: any token will do."""
    if (what := f"{method} {path}") in ANY:
        return None
    if method == "GET" or (what.startswith(LOOKS) and method == "POST"):
        return {"read"}
    return OTHERS.get(what, {"steer"})


@pytest.fixture
def app(rig_file: RigFile, tmp_path: Path) -> Iterator[FastAPI]:
    service = Service(rig_file, tmp_path / "root")
    yield create_app(service, Access(Tokens(tmp_path / "tokens.json")))
    service.close()


def test_every_route_has_a_decided_scope_and_no_other_has(app):
    decided = sorted((route.method, route.path) for _, route in ROUTES)
    without = [(method, path.replace(":path}", "}")) for method, path in decided]
    assert [(m, p.replace(":path}", "}")) for m, p in routes_of(app)] == sorted(without)
    viewer = create_viewer(Viewing(lambda: [], lambda _: None, None), Access())  # type: ignore[arg-type]
    assert set(routes_of(viewer)) <= set(routes_of(app))


def test_a_token_of_one_scope_opens_what_that_scope_opens(app, tmp_path):
    tokens = Tokens(tmp_path / "tokens.json")
    made = {scope: tokens.make(scope, (scope,)) for scope in SCOPES}
    requested = 0
    for method, path in routes_of(app):
        public = path in OPEN or path.startswith(("/web/", "/view/page/"))
        if public or (method, path) in (("POST", "/login"), ("GET", "/events")):
            continue
        needed = expected(method, path)
        for scope, token in made.items():
            url = f"{method} {path}" + ("?force=true" if "lease" in path else "")
            mine = {"Authorization": f"Bearer {token}"}
            response = send(app, url, mine, json=[])
            requested += 1
            if needed is None or scope in needed:
                assert response.status_code not in (401, 403) or "lease" in path, (url, scope)
            else:
                assert refused(response, "forbidden", 403)["scope"] in needed, (url, scope)
    assert requested > 300


def test_the_description_of_the_api_names_the_same_scopes(app):
    for path, operations in app.openapi()["paths"].items():
        for method, operation in operations.items():
            if (method, path) == ("post", "/login"):
                continue
            needed = expected(method.upper(), path) or set()
            (named,) = operation["security"]
            assert named["token"] == (sorted(needed) if len(needed) == 1 else []), path


def test_a_request_without_the_scope_is_refused_before_its_body_is_read(app, tmp_path):
    """Four uploads of a read token, which may not upload, kept everybody else's waiting."""
    token = Tokens(tmp_path / "tokens.json").make("reader", ("read",))
    taken: list[int] = []

    async def body() -> AsyncIterator[bytes]:
        taken.append(1)
        yield b"v 0 0 0"

    # `Expect`: else what still comes of a refused request is taken and forgotten.
    headers = {"Authorization": f"Bearer {token}", "Expect": "100-continue"}
    response = send(app, "PUT /uploads/x/head.obj", headers, content=body())
    assert refused(response, "forbidden", 403)["scope"] == "steer"
    assert taken == []
