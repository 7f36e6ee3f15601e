"""What browsers may do with answers: every route has safe headers, without a line of its own."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI, Response
from serving import Client, serving
from starlette.routing import Route

from reconstruction import Model
from stage_service.api.app import create_app
from stage_service.api.gate import Access
from stage_service.records.tokens import Tokens
from stage_service.web.headers import SafeHeaders, attachment

SHORT = {"lights": ["light_003"], "projectors": []}
PNG = b"\x89PNG\r\n\x1a\n" + bytes(8)
PARTS = {"model": "m", "name": "m", "subject": "anna", "step": "2", "camera": "cam_0"}
PARTS |= {"path": "index.html", "file": "style.css", "which": "model"}
"""What stands in the place of a path's parameters."""
OURS = re.compile(r"/$|/docs$|/favicon.ico$|/web/|/view$|/view/page/")
"""The product's own pages: they name nobody, and a browser may keep them."""


HARMLESS = {"", "application/json", "application/octet-stream", "application/problem+json"}
HARMLESS |= {
    "image/jpeg",
    "image/png",
    "image/webp",
    "text/event-stream",
    "text/markdown",
    "text/plain",
}


def directives(response: httpx.Response) -> dict[str, str]:
    """The response's Content-Security-Policy by its directives."""
    parts = (p.split(maxsplit=1) for p in response.headers["content-security-policy"].split(";"))
    return {name: "".join(rest) for name, *rest in parts}


@pytest.fixture
def filled(http: Client) -> Client:
    """A service with a capture, a job whose model has files, an upload, something in the trash."""
    shot = http.post("/captures", json={"plan": SHORT}).json()["id"]
    http.service._captures.wait(shot, 60)
    requested = {"capture": shot, "pipeline": {"name": "reconstruct"}, "model": "m"}
    job = http.post("/jobs", json=requested).json()["id"]
    model = Model(http.service.root / "models" / "m").create()
    for name, data in (("index.html", b"<p>"), ("report.json", b"{}"), ("relit.png", PNG)):
        model.file(name).write_bytes(data)
    http.put("/uploads/anna/head.obj", content=b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    PARTS.update(capture=shot, job=job)
    return http


def paths(routers: Iterable[Any]) -> Iterator[tuple[str, str]]:
    """The methods and paths of all routes, those of routers in it, too."""
    for route in routers:
        if isinstance(route, Route):
            yield from ((method, route.path) for method in route.methods or ())
        elif (inner := getattr(route, "original_router", route)) is not None:
            yield from paths(inner.routes)


def test_every_route_sends_safe_headers(filled):
    """With what there is, and with nothing: an answer, a refusal and a fault have them alike."""
    known = sorted(paths(create_app(filled.service).routes))  # GET comes before all but DELETE
    known.sort(key=lambda route: route[0] != "GET")
    assert len(known) > 60
    got = {}
    for method, path in known:
        url = re.sub(r"{(\w+)(:path)?}", lambda m: PARTS.get(m[1], "none"), path)
        url = url.replace("/web/m", "/web/main.js")
        with filled.stream(method, url) as reply:
            got[method, path] = reply.status_code
            safe(reply, url)
    reads = [status for (method, _), status in got.items() if method == "GET"]
    assert reads.count(200) > 0.7 * len(reads), got


def safe(reply: httpx.Response, url: str) -> None:
    reported = reply.headers
    assert reported["x-content-type-options"] == "nosniff", url
    assert reported["referrer-policy"] == "no-referrer", url
    assert reported["cross-origin-resource-policy"] == "same-origin", url
    limits = directives(reply)
    assert limits["default-src"] == limits["base-uri"] == limits["form-action"] == "'none'", url
    assert limits["frame-ancestors"] == "'none'", url
    if reply.status_code == 200 and OURS.match(url):
        assert reported["cache-control"] == "no-cache", url
        assert "unsafe" not in reported["content-security-policy"], url
        assert limits["script-src"] == limits["style-src"] == "'self'", url
    else:
        assert reported["cache-control"] == "private, no-store", url
        assert "sandbox" in limits, url
        assert "allow-scripts" not in limits["sandbox"], url
        assert "script-src" not in limits, url
        kind = reported.get("content-type", "").partition(";")[0]
        report = url.endswith("/index.html")
        attached = reported.get("content-disposition", "").startswith("attachment")
        assert kind in HARMLESS or report or attached, (url, kind)


def test_a_new_route_is_safe_by_itself_whatever_it_says_of_caching():
    app = FastAPI()
    app.add_middleware(SafeHeaders)

    @app.get("/new")
    def new() -> Response:
        return Response(b"a face", headers={"Cache-Control": "max-age=60"})

    async def get(path: str) -> httpx.Response:
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://here") as client:
            return await client.get(path)

    for path in ("/new", "/other"):
        safe(asyncio.run(get(path)), path)


def test_refusals_have_them_too(rig_file, tmp_path):
    with serving(rig_file, tmp_path / "root", Access(Tokens(tmp_path / "t", "own"))) as http:
        for reply, status in (
            (http.get("/captures"), 401),
            (http.get("/", headers={"Host": "elsewhere"}), 421),
            (http.post("/login", json={}, headers={"Origin": "http://elsewhere"}), 403),
            (http.post("/login", content=bytes(2 << 20)), 413),
        ):
            assert reply.status_code == status
            safe(reply, "/refused")


FILES = {
    "report.json": (b"{}", "application/json"),
    "relit.png": (PNG, "image/png"),
    "relit.webp": (b"RIFF\0\0\0\0WEBPVP8 ", "image/webp"),
    "relit.jpg": (b"\xff\xd8\xff\xe0", "image/jpeg"),
    "fake.png": (b"<script>", None),
    "fake.webp": (b"<svg>", None),
    "x.svg": (b"<svg xmlns='http://www.w3.org/2000/svg'/>", None),
    "plots/index.html": (b"<script>", None),
    "x.xhtml": (b"<html/>", None),
    "x.xml": (b"<html/>", None),
    "x.pdf": (b"%PDF-1.7", None),
    "x.js": (b"alert(1)", None),
    'Ä "q".txt': (b"text", None),
}


def test_files_of_a_model_are_shown_only_where_they_are_what_they_are_called(filled):
    for name, (data, kind) in FILES.items():
        file = filled.service.root / "models" / "m" / name
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(data)
        reply = filled.get(f"/jobs/{PARTS['job']}/artifacts/{name}")
        assert reply.content == data
        safe(reply, "/artifact")
        reported = reply.headers["content-type"], reply.headers.get("content-disposition")
        saved = "application/octet-stream", attachment(Path(name).name)
        assert reported == (saved if kind is None else (kind, None)), name


def test_the_page_of_a_model_shows_its_own_pictures_alone_and_runs_nothing(filled):
    url = f"/jobs/{PARTS['job']}/artifacts/index.html"
    reply = filled.get(url)
    assert reply.headers["content-type"] == "text/html; charset=utf-8"
    limits, host = directives(reply), filled.base_url.netloc.decode()
    assert limits["img-src"] == f"{host}{url.removesuffix('index.html')} data:"
    assert limits["sandbox"] == "allow-same-origin allow-downloads"
    six = filled.get(url, headers={"Host": "[::1]:80"})
    assert directives(six)["img-src"] == "'self' data:"


def test_a_name_in_a_header_is_a_name_and_nothing_else():
    reported = attachment('a"b\r\nSet-Cookie: x=1\\é.tar')
    assert "\r" not in reported
    assert "\n" not in reported
    assert reported.count('"') == 2
    assert reported.endswith("filename*=UTF-8''a%22b%0D%0ASet-Cookie%3A%20x%3D1%5C%C3%A9.tar")
