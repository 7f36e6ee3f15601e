"""A model that somebody else made, opened in the browser of whoever is logged in: it does nothing.

And the model's page as hairstage writes it, which is to look as it does from the disk.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browsing import PATIENCE_MS
from serving import Client, serving

from reconstruction import Model, Strands
from reconstruction.report.report import Report
from stage_service.api.gate import Access
from stage_service.model_page import write_page
from stage_service.records.tokens import Tokens

STEER = """fetch('/lease', {method: 'POST', headers: {'content-type': 'application/json'},
body: '{"holder": "a model"}'}); document.title = 'ran';
document.documentElement.setAttribute('data-ran', 'yes');"""
SCRIPT = f"<script>{STEER}</script>"
SVG = (
    "<svg xmlns='http://www.w3.org/2000/svg' width='9' height='9' onload=\"document.title='ran'\">"
)
SVG += f"<script>{STEER.replace('&', '&amp;')}</script></svg>"
XHTML = f"<html xmlns='http://www.w3.org/1999/xhtml'><head>{SCRIPT}</head><body/></html>"
FORM = "<form id=f method=post action='/devices/blackout'><button id=b>go</button></form>"
DATA = "data:text/html," + SCRIPT.replace("\n", " ")
PDF = b"""%PDF-1.4
1 0 obj<</Type/Catalog/Pages 2 0 R/OpenAction<</S/JavaScript/JS(this.submitForm('/lease'))>>>>endobj
2 0 obj<</Type/Pages/Kids[]/Count 0>>endobj
trailer<</Root 1 0 R>>
"""
FILES: dict[str, str | bytes] = {
    "x.svg": SVG,
    "plots/refresh.html": f'<meta http-equiv=refresh content="0;url={DATA}">{SCRIPT}',
    "plots/form.html": FORM + "<script>document.forms[0].submit()</script>",
    "plots/fetch.html": SCRIPT,
    "plots/frame.html": f"<iframe src='/'></iframe><iframe src=\"{DATA}\"></iframe>{SCRIPT}",
    "plots/data.html": f'<script src="data:,document.title=%27ran%27"></script>{SCRIPT}',
    "x.xhtml": XHTML,
    "x.xml": f"<?xml version='1.0'?><?xml-stylesheet href='x.svg' type='text/xsl'?>{XHTML}",
    "fake.png": f"<html>{SCRIPT}</html>",
    "fake.json": f"<html>{SCRIPT}</html>",
    "x.pdf": PDF,
    "x.js": STEER,
}
PAGE = f"""<!doctype html><html><head><meta charset=utf-8><title>quiet</title>
<base href="https://elsewhere.test/"><link rel=stylesheet href="https://elsewhere.test/a.css">
<meta http-equiv=refresh content="0;url=/jobs/JOB/artifacts/plots/fetch.html">
{SCRIPT}<script src=x.js></script></head><body onload="document.title='ran'">
<img src=nothing onerror="{STEER.replace('"', "&quot;")}"><img src=x.svg>
<img src="/captures/CAPTURE/frames/2/cam_0.png"><img src="https://elsewhere.test/a.png">
<iframe src="/"></iframe><iframe srcdoc="{SCRIPT.replace('"', "&quot;")}"></iframe>
<object data=x.svg></object><embed src=x.svg>{SVG}{FORM}
<a id=js href="javascript:document.title='ran'">js</a>
<a id=away target=_blank href="/devices">away</a></body></html>"""


@pytest.fixture
def hostile(rig_file, tmp_path) -> Iterator[tuple[Client, str, str]]:
    """A service with a job whose model has these files: the service, the job, its capture."""
    tokens = Tokens(tmp_path / "tokens.json", "own")
    with serving(rig_file, tmp_path / "root", Access(tokens)) as http:
        http.headers["Authorization"] = "Bearer own"
        plan = {"lights": ["light_003"], "projectors": []}
        capture = http.post("/captures", json={"plan": plan}).json()["id"]
        shot = http.service._captures.wait(capture, 60)
        assert shot.outcome == "completed", shot
        job_request = {"capture": capture, "pipeline": {"name": "reconstruct"}, "model": "m"}
        job = http.post("/jobs", json=job_request).json()["id"]
        model = Model(http.service.root / "models" / "m").create().path
        (model / "plots").mkdir()
        for name, data in FILES.items():
            (model / name).write_bytes(data if isinstance(data, bytes) else data.encode())
        page = PAGE.replace("CAPTURE", capture).replace("JOB", job)
        (model / "index.html").write_text(page)
        yield http, job, capture


@pytest.fixture
def tab(hostile, browser) -> Iterator[Any]:
    """A page of a browser that is logged in."""
    http, _, _ = hostile
    context = browser.new_context(base_url=str(http.base_url))
    context.set_default_timeout(PATIENCE_MS)
    context.request.post("/login", data={"token": "own"})
    assert context.request.get("/captures").status == 200, "the cookie opens the service"
    yield context.new_page()
    context.close()


def test_a_hostile_model_opened_in_many_ways_does_nothing(hostile, tab, world):
    http, job, _ = hostile
    before, pulses = [a["action"] for a in http.get("/audit").json()], world.pulses
    sent: list[str] = []
    refused: set[str] = set()
    tab.context.on("request", lambda r: sent.append(f"{r.method} {r.url}"))
    tab.context.on("requestfailed", lambda r: refused.add(r.url) if r.failure == "csp" else None)
    for name in ("index.html", *FILES):
        with suppress(Exception):  # a download is no page
            tab.goto(f"/jobs/{job}/artifacts/{name}", wait_until="load")
        tab.wait_for_timeout(300)  # for what a page would do by itself
        assert tab.title() != "ran", name
        assert 'data-ran="yes"' not in tab.content(), name
    tab.goto(f"/jobs/{job}/artifacts/index.html", wait_until="load")
    for click in ("#b", "#js", "#away"):
        with suppress(Exception):  # a button that does nothing is waited for in vain
            tab.click(click, timeout=2000, no_wait_after=True)
        tab.wait_for_timeout(200)
        assert tab.title() == "quiet", click
    assert len(tab.context.pages) == 1
    assert [s for s in sent if not s.startswith("GET ")] == []
    elsewhere = {s.split()[1] for s in sent if "elsewhere" in s or "/frames/" in s}
    assert len(elsewhere) == 3, "a style and pictures of other places were looked for,"
    assert elsewhere <= refused, "and refused by the browser before anything was sent"
    assert http.get("/lease").json()["holder"] is None
    assert [a["action"] for a in http.get("/audit").json()] == before
    assert (world.lit, world.pulses) == (set(), pulses)


def test_a_page_of_the_service_has_no_part_of_the_model_that_acts(hostile, tab):
    """As an image of the console, and as a frame, a script or a style of a page of the service."""
    _, job, _ = hostile
    tab.goto("/")
    ran = tab.evaluate(
        """async (folder) => {
            const one = (tag, more) => new Promise((done) => {
                const e = Object.assign(document.createElement(tag), more);
                e.onload = () => done(`${tag} loaded`); e.onerror = () => done(`${tag} failed`);
                document.body.append(e); setTimeout(() => done(`${tag} silent`), 1500);
            });
            return [await one("script", { src: folder + "x.js" }),
                await one("link", { rel: "stylesheet", href: folder + "fake.png" }),
                await one("img", { src: folder + "x.svg" }), document.title];
        }""",
        f"/jobs/{job}/artifacts/",
    )
    assert ran[:2] == ["script failed", "link failed"]
    assert "ran" not in ran[3]


def test_the_page_of_a_model_looks_as_it_does_from_the_disk(hostile, tab):
    http, job, _ = hostile
    model = Model(http.service.root / "models" / "m")
    model.write_strands(Strands.from_list([[[0, 0, 0], [0, 0, 0.1]]] * 3, radius=1e-4))
    model.write_png("relit.png", np.full((40, 60, 3), 128, np.uint8))
    report = Report()
    with report.stage("reconstruction") as stage:
        stage.figures = {"points": 3}
    model.write_report(report)
    write_page(model)
    complaints: list[str] = []
    tab.on("console", lambda m: complaints.append(m.text) if m.type == "error" else None)
    shown = {}
    for where in (f"/jobs/{job}/artifacts/index.html", model.file("index.html").as_uri()):
        tab.goto(where)
        tab.wait_for_selector("main")
        shown[where] = tab.screenshot(full_page=True)
        images = tab.locator("img").evaluate_all("all => all.map((i) => i.naturalWidth)")
        assert images
        assert set(images) == {60}, where
    assert complaints == []
    ours, disk = (
        cv2.imdecode(np.frombuffer(p, np.uint8), cv2.IMREAD_COLOR) for p in shown.values()
    )
    np.testing.assert_array_equal(ours, disk)
    tab.goto(f"/jobs/{job}/artifacts/index.html")
    with tab.expect_download() as download:
        tab.click("a[href='strands.usdc']")
    assert Path(download.value.path()).read_bytes() == model.file("strands.usdc").read_bytes()


def test_no_picture_of_a_person_is_left_in_the_browser_after_the_logout(hostile, tab):
    _, job, capture = hostile
    tab.goto("/")
    frame = f"/captures/{capture}/frames/2/cam_0"
    model = f"/jobs/{job}/artifacts"
    paths = [f"{frame}.png?size=64", f"{frame}.exr", f"{frame}.json", f"{model}/x.js", "/audit"]
    get = "(all) => Promise.all(all.map(async (path) => (await fetch(path)).status))"
    assert tab.evaluate(get, paths) == [200] * 5
    assert tab.evaluate("async () => (await fetch('/logout', { method: 'POST' })).status") == 200
    assert tab.evaluate(get, paths) == [401] * 5
