"""Who gets in, from where, with what, and what the audit has of it."""

from __future__ import annotations

import argparse
import asyncio
import json
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from serving import URL, refused, send, serving

from stage_service.api import bodies
from stage_service.api.app import create_app
from stage_service.api.gate import Access
from stage_service.cli import main
from stage_service.cli.stage import processes
from stage_service.cli.support.commands import Output
from stage_service.config import RigFile
from stage_service.records.tokens import SCOPES, TokenError, Tokens
from stage_service.service import Service


@pytest.fixture
def service(rig_file: RigFile, tmp_path: Path) -> Iterator[Service]:
    service = Service(rig_file, tmp_path / "root")
    yield service
    service.close()


@pytest.fixture
def tokens(tmp_path: Path) -> Tokens:
    return Tokens(tmp_path / "root" / "tokens.json", own="mine")


@pytest.fixture
def call(service: Service, tokens: Tokens) -> Callable[..., httpx.Response]:
    """`ask("GET /captures", token, …)`"""
    app = create_app(service, Access(tokens))

    def call(what: str, token: str | None = None, **more: Any) -> httpx.Response:
        headers = more.pop("headers", {})
        if token is not None:
            headers["Authorization"] = f"Bearer {token}"
        return send(app, what, headers, **more)

    return call


def done(service: Service) -> list[tuple[str, str]]:
    """Who did what, without what was refused."""
    return [(a.who.split(" ")[0], a.action) for a in service.audit(1000) if a.result != "refused"]


def test_every_route_requires_a_token(call, service):
    document = call("GET /openapi.json").json()
    assert call("GET /docs").status_code == call("GET /docs/errors.md").status_code == 200
    routes = [(m, path, op) for path, ops in document["paths"].items() for m, op in ops.items()]
    assert len(routes) > 20
    for method, path, operation in routes:
        if (method, path) == ("post", "/login"):
            continue
        assert operation["security"], path
        for token in (None, "guessed", ""):
            refused(call(f"{method.upper()} {path}", token), "unauthorized", 401)
    assert call("GET /captures").headers["www-authenticate"] == "Bearer"
    assert done(service) == []


def test_arming_and_pipelines_need_scopes_of_their_own(call, tokens):
    token = tokens.make("x", ("read", "steer"))
    armed = {"armed_by": "Ada", "plan": {"lights": ["nope"]}}
    assert refused(call("POST /captures", token, json=armed), "forbidden", 403)["scope"] == "arm"
    then = {"pipeline": {"name": "light_planes"}}
    assert refused(call("POST /captures", token, json=then), "forbidden", 403)["scope"] == "jobs"
    again = call("POST /captures/x/resume", token, json={"armed_by": "Ada"})
    assert refused(again, "forbidden", 403)["scope"] == "arm"


def test_the_audit_has_whose_token_it_was(call, tokens):
    everything, other = tokens.make("ada", SCOPES), tokens.make("bob", ("steer",))
    assert call("POST /lease", other, json={"holder": "Bob", "seconds": 60}).status_code == 201
    refused(call("DELETE /lease", everything), "no-lease", 409)
    assert call("DELETE /lease?force=true", everything).json()["holder"] is None
    refused(call("DELETE /jobs/x", everything), "unknown-job", 404)
    job = {"capture": "x", "pipeline": {"name": "fit"}}
    refused(call("POST /jobs", everything, json=job), "unknown-capture", 404)
    call("POST /devices/blackout", other)
    found = [
        (a["who"].split(" ")[0], a["action"], a["result"])
        for a in call("GET /audit", everything).json()
    ]
    assert found == [
        ("bob", "lease.take", "ok"),
        ("ada", "lease.release", "refused"),
        ("ada", "lease.end", "ok"),
        ("ada", "job.cancel", "refused"),
        ("ada", "job.submit", "refused"),
        ("bob", "blackout", "dark"),
    ]


def test_a_token_that_is_revoked_opens_nothing_any_more(call, tmp_path, capsys):
    root = ["--root", str(tmp_path / "root")]
    assert main(["token", "make", "ada", "--scopes", "read", *root]) == 0
    token = capsys.readouterr().out.strip()
    assert call("GET /lease", token).status_code == 200
    file = tmp_path / "root" / "tokens.json"
    assert token not in file.read_text()
    assert file.stat().st_mode & 0o777 == 0o600
    assert main(["token", "list", "--json", *root]) == 0
    listed = json.loads(capsys.readouterr().out)["tokens"]
    assert [(e["name"], e["scopes"], "sha256" in e) for e in listed] == [("ada", ["read"], False)]
    assert main(["token", "make", "ada", *root]) == 3
    assert main(["token", "make", "bob", "--scopes", "read,everything", *root]) == 3
    assert main(["token", "revoke", "ada", *root]) == 0
    refused(call("GET /lease", token), "unauthorized", 401)
    assert main(["token", "revoke", "ada", *root]) == 3
    actions = [(a["action"], a["subject"]) for a in call("GET /audit", "mine").json()]
    assert actions == [("token.make", "ada"), ("token.revoke", "ada")]


def test_a_damaged_file_of_tokens_opens_nothing(call, tokens, tmp_path):
    token = tokens.make("ada", SCOPES)
    for text in ("", "[", '[{"name": "ada"}]', '{"a": 1}', "[1]", "[" * 10**5):
        (tmp_path / "root" / "tokens.json").write_text(text)
        refused(call("GET /lease", token), "unauthorized", 401)
        with pytest.raises(TokenError, match=r"tokens\.json"):
            tokens.make("bob", ())
    assert call("GET /lease", "mine").status_code == 200  # of whoever runs the service


def test_an_empty_file_of_one_s_own_token_opens_nothing(service, tmp_path, monkeypatch, capsys):
    (tmp_path / "token").write_text("\n")
    monkeypatch.setenv("HAIRSTAGE_TOKEN_FILE", str(tmp_path / "token"))
    args = argparse.Namespace(no_auth=False, root=tmp_path / "root", root_path="")
    app = create_app(service, processes._access(args, set(), Output(as_json=False)))
    refused(send(app, "GET /audit", {"Authorization": "Bearer "}), "unauthorized", 401)
    assert "is empty: remove it" in capsys.readouterr().err
    assert main(["token", "show"]) == 3


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1", "x"])
def test_requests_of_another_site_are_refused(service, origin):
    """Also where no token is asked for: a browser sends the request, whoever made the page."""
    app = create_app(service)
    headers = {"Origin": origin, "Content-Type": "text/plain"}
    for what in ("/captures/x/resume", "/devices/blackout", "/captures"):
        detail = refused(send(app, f"POST {what}", headers), "foreign-origin", 403)["detail"]
        assert "Host is '127.0.0.1'" in detail
        assert "proxy_set_header Host $http_host;" in detail
    assert send(app, "POST /devices/blackout", {"Origin": URL}).status_code == 200
    for host in ("evil.example", "127.0.0.1.evil.example", ""):
        refused(send(app, "GET /lease", {"Host": host}), "http", 421)
    assert done(service) == [("127.0.0.1:123", "blackout")]


def test_a_request_is_no_larger_than_it_need_be(call, tokens):
    token = tokens.make("ada", SCOPES)

    async def long() -> AsyncIterator[bytes]:
        for _ in range(bodies.MOST_BODY // 1000 + 1):
            yield b"a" * 1000

    for content in (long(), b"a" * (bodies.MOST_BODY + 1)):
        refused(call("POST /captures", token, content=content), "too-large", 413)
    names = [f"x{i}" for i in range(4097)]
    for plan in ({"lights": names}, {"projectors": names}, {"lights": ["x" * 101]}):
        refused(call("POST /plans:validate", token, json=plan), "invalid-request", 422)
    plan = {"lights": [*names[1:4000], "x1"]}
    reported = refused(call("POST /plans:validate", token, json=plan), "invalid-plan", 422)[
        "problems"
    ]
    assert (len(reported), reported[-1]) == (21, "lights: 3981 more such names")


def test_a_token_that_is_revoked_ends_what_follows_the_events(rig_file, tmp_path):
    tokens = Tokens(tmp_path / "tokens.json")
    access = Access(tokens)
    headers = {"Authorization": f"Bearer {tokens.make('ada', ('read',))}"}
    with (
        serving(rig_file, tmp_path, access) as http,
        http.stream("GET", "/events?after=0", headers=headers) as response,
    ):
        assert response.status_code == 200
        http.service.events.publish("test", {})
        lines = response.iter_lines()
        assert any(line.startswith("event: test") for line in lines)
        tokens.revoke("ada")
        for _ in lines:  # it ends
            pass
        assert http.get("/lease", headers=headers).status_code == 401


def test_tokens_that_are_made_at_the_same_time_are_all_there(tmp_path):
    """Each `Tokens` stands for a process: they share nothing but the file."""

    def make(of: int) -> None:
        for number in range(5):
            Tokens(tmp_path / "tokens.json").make(f"{of}-{number}", ("read",))

    makers = [threading.Thread(target=make, args=(n,)) for n in range(6)]
    for maker in makers:
        maker.start()
    for maker in makers:
        maker.join()
    assert len(Tokens(tmp_path / "tokens.json").entries()) == 30


def test_only_a_check_that_may_be_old_misses_a_revoked_token(tmp_path):
    """Connections are admitted by an old check, their requests by a new one."""
    elsewhere = Tokens(tmp_path / "tokens.json")
    token, here = elsewhere.make("ada", ("read",)), Tokens(tmp_path / "tokens.json")
    assert here.find(token) is not None
    elsewhere.revoke("ada")
    assert here.find(token, within_s=3600) is not None
    assert here.find(token) is None
    assert here.find(token, within_s=3600) is None


def test_a_browser_that_logs_in_needs_no_token_any_more(call, tokens, service):
    token = tokens.make("ada", ("read", "steer"))
    refused(call("POST /login", json={"token": "guessed"}), "unauthorized", 401)
    refused(call("POST /login", json={}), "invalid-request", 422)
    response = call("POST /login", json={"token": token})
    assert response.json()["name"] == "ada"
    assert response.json()["scopes"] == ["read", "steer"]
    cookie, *rules = response.headers["set-cookie"].split("; ")
    assert rules == ["Path=/", "Max-Age=43200", "HttpOnly", "SameSite=Strict"]
    assert token not in cookie
    logged_in = {"headers": {"Cookie": f"theme=dark; {cookie}"}}
    assert call("GET /login", **logged_in).json()["name"] == "ada"
    assert call("GET /captures", **logged_in).status_code == 200
    refused(call("POST /jobs", json={}, **logged_in), "forbidden", 403)
    for header in (f"{cookie}x", cookie.partition("=")[0], f"hairstage={token}", "=;;"):
        refused(call("GET /captures", headers={"Cookie": header}), "unauthorized", 401)
    assert done(service) == [("ada", "login")]


def test_a_login_over_tls_stays_there_and_each_port_has_its_own(service, tokens):
    app = create_app(service, Access(tokens))

    def log_in(url: str) -> str:
        async def response() -> str:
            async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url=url) as http:
                sent = await http.post("/login", json={"token": "mine"}, headers={"Origin": url})
                return sent.headers["set-cookie"]

        return asyncio.run(response())

    name, _, rules = log_in("https://127.0.0.1").partition("=")
    assert (name, rules[-8:]) == ("__Host-hairstage", "; Secure")
    names = [log_in(f"http://localhost:{port}").partition("=")[0] for port in (8331, 8332)]
    assert names == ["hairstage-8331", "hairstage-8332"]


def test_without_required_tokens_a_login_sets_no_cookie(service):
    response = send(create_app(service), "POST /login", {}, json={"token": "any"})
    assert response.json() == {"name": "", "scopes": list(SCOPES), "blackout": None}
    assert "set-cookie" not in response.headers
