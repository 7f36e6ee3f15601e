"""The viewer in a browser: it draws, turns, complains of nothing and asks nobody else."""

from __future__ import annotations

import base64
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import pytest
from waiting import until

from appearance import Exposure, HairAppearance, render_olat
from appearance.model.fitted_model import FittedModel
from appearance.observations import HeldOut
from appearance.render.olat import render_indirect
from appearance.sun_fit.fitted_appearance import FittedAppearance
from reconstruction import Camera, Light, Model, Strands

api = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
pytestmark = [
    pytest.mark.slow,  # a browser without a GPU takes minutes of a busy machine
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here"),
]
PATIENCE_MS = 300_000
HAIR = HairAppearance((0.1, 0.3, 0.9), 0.3, 0.25, tilt_deg=2)


def fibre() -> Strands:
    """One bent fibre of 5 cm, 2 mm wide: a few pixels."""
    s = np.linspace(-0.025, 0.025, 40)
    return Strands.from_list([np.stack([s, 4 * s**2, 0.3 * s], 1)], radius=1e-3)


def bundle() -> Strands:
    """200 fibres that hide each other, 1 mm wide; some run through others."""
    rng = np.random.default_rng(3)
    s = np.linspace(-0.02, 0.02, 24)[:, None]
    lines = []
    for _ in range(200):
        turned = rng.normal(size=3) * 0.3
        lines.append(
            rng.uniform(-0.015, 0.015, 3) * [0.3, 1, 1] + s * (np.array([1, 0, 0]) + turned)
        )
    return Strands.from_list(lines, radius=5e-4)


GROOMS = {"fibre": fibre, "bundle": bundle}


@dataclass
class ViewerPage:
    """A page, what it complained of, and the hosts that it asked."""

    page: Any
    complaints: list[str] = field(default_factory=list)
    hosts: set[str] = field(default_factory=set)

    def picture(self) -> np.ndarray:
        """What is on the canvas `(H, W, 4)`, 0 to 255."""
        url = self.page.evaluate("document.getElementById('canvas').toDataURL()")
        data = np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8)
        return cv2.imdecode(data, cv2.IMREAD_UNCHANGED)

    def lit(self, lights: list[Light]) -> tuple[Camera, np.ndarray, list[int]]:
        """Have it draw lit when it is told: its view of 96² pixels, the eye, and the numbers of the
        lights in front, at the side and behind."""
        self.drawn("viewer.relight")
        self.page.evaluate("() => { viewer.frame = () => {}; }")
        self.page.select_option("select >> nth=0", "lit")
        self.page.wait_for_function("viewer.relight.visibility", timeout=PATIENCE_MS)
        values = self.page.evaluate(
            "(() => { const { K, R, t } = viewer.orbit.pinhole(96, 96); return { K, R, t }; })()"
        )
        camera = Camera("orbit", 96, 96, *(np.array(values[k]) for k in "KRt"))
        eye = camera.center
        ways = np.array([x.position / np.linalg.norm(x.position) for x in lights])
        places = (eye, np.cross(eye, [0, 0, 1.0]), -eye)
        return camera, eye, [int((ways @ w).argmax()) for w in places]

    def at_rest(self, number: int, ambient: float) -> np.ndarray:
        """The picture at rest `(96, 96, 3)` under one light, radiance."""
        self.page.evaluate(f"viewer.relight.set({{{number}: [1, 1, 1]}})")
        self.page.wait_for_function(
            f"!viewer.relight.applying && viewer.relight.lights[0]?.number === {number}",
            timeout=PATIENCE_MS,
        )
        values = self.page.evaluate(AT_REST, ambient)
        return np.array(values, np.float32).reshape(96, 96, 4)[::-1, :, :3]

    def drawn(self, what: str = "true") -> None:
        """Wait until everything is there and drawn, and `what` holds."""
        self.page.wait_for_function(
            "window.viewer?.complete && !viewer.moved && viewer.picture.ready() && "
            f"viewer.picture.frames > 0 && {what}",
            timeout=PATIENCE_MS,
        )


@pytest.fixture
def model(tmp_path, request):
    """Strands that a test names, with a material; else bristles on a sphere."""
    which = getattr(request, "param", None)
    if which is None:
        return request.getfixturevalue("bristly")
    made = Model(tmp_path / "bristles").create()
    made.write_strands(GROOMS[which]())
    grey = (0.2,) * 3
    FittedAppearance(HAIR, grey, grey, Exposure(1.0), 0.1, 0.1, 0.1, HeldOut()).save(made)
    return made


@pytest.fixture
def viewer_page(url: str) -> Iterator[ViewerPage]:
    with visited(url, bypass_csp=True) as viewer_page:  # waiting for an expression needs eval
        yield viewer_page


@contextmanager
def visited(url: str, **more: Any) -> Iterator[ViewerPage]:
    arguments = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with api.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=CHROMIUM, args=arguments, timeout=PATIENCE_MS)
        page = browser.new_page(viewport={"width": 900, "height": 500}, **more)
        viewer_page = ViewerPage(page)
        page.on(
            "console",
            lambda m: viewer_page.complaints.append(m.text) if m.type == "error" else None,
        )
        page.on("pageerror", lambda e: viewer_page.complaints.append(str(e)))
        page.on(
            "request", lambda r: viewer_page.hosts.add(r.url.partition("://")[2].partition("/")[0])
        )
        page.goto(f"{url}/view#model=bristles&token=the%20key", timeout=PATIENCE_MS)
        yield viewer_page
        browser.close()


def test_the_page_needs_nothing_that_its_policy_refuses(url):
    with visited(url) as viewer_page:
        done = "Boolean(window.viewer?.complete && viewer.picture.ready() && viewer.picture.frames)"
        until(lambda: viewer_page.page.evaluate(done), pause=0.1)
        assert (viewer_page.picture()[..., 3] > 0).any()
        viewer_page.page.select_option("select >> nth=0", "length")
        assert viewer_page.complaints == []


def test_strands_are_drawn_turn_and_take_another_colour(viewer_page, url):
    viewer_page.drawn()
    assert "400 strands" in viewer_page.page.inner_text("#panel")
    before = viewer_page.picture()
    # a half ball of 13 cm, whole in the picture
    assert 0.05 < (before[..., 3] > 0).mean() < 0.75
    viewer_page.page.focus("#canvas")
    viewer_page.page.keyboard.press("ArrowLeft")
    viewer_page.page.wait_for_function("viewer.orbit.azimuth > -50", timeout=PATIENCE_MS)
    viewer_page.drawn()
    assert np.abs(viewer_page.picture().astype(int) - before).mean() > 1

    viewer_page.page.select_option("select >> nth=0", "length")
    viewer_page.page.select_option("select >> nth=1", "truth")
    viewer_page.drawn("viewer.picture.state.mode === 'length'")
    hair = viewer_page.picture()
    yellow = (hair[..., 2] > 1.5 * hair[..., 0]) & (hair[..., 1] > 1.5 * hair[..., 0])
    assert yellow.sum() > 500  # all are as long as the longest
    assert viewer_page.complaints == []
    assert viewer_page.hosts == {url.partition("://")[2]}
    assert "token" not in viewer_page.page.evaluate("location.href")


@pytest.mark.parametrize(
    ("model", "allowed"), [("fibre", 0.015), ("bundle", 0.035)], indirect=["model"]
)
def test_direct_light_is_that_of_the_path_tracer(viewer_page, model, viewing, allowed):
    """From in front, from the side, from behind; the picture's sum beside paths of one vertex."""
    lighting = viewing.get("bristles").lighting
    camera, _, numbers = viewer_page.lit(lighting.lights)
    scene = FittedModel.load(model).scene()
    expected = render_olat(
        scene, camera, [lighting.lights[n] for n in numbers], spp=256, max_depth=1, thrift=0
    )
    for number, picture in zip(numbers, expected, strict=True):
        found = viewer_page.at_rest(number, 0)
        np.testing.assert_allclose(found.sum(axis=(0, 1)), picture.sum(axis=(0, 1)), rtol=allowed)
    assert viewer_page.complaints == []


@pytest.mark.parametrize("model", ["bundle"], indirect=True)
def test_at_rest_light_between_fibres_is_that_of_the_path_tracer(viewer_page, model, viewing):
    """From the side: which pixels have it, and how much of it there is. The bundle is much the same
    upside down, its light is not."""
    lighting = viewing.get("bristles").lighting
    camera, _, (_, side, _) = viewer_page.lit(lighting.lights)
    found = viewer_page.at_rest(side, 1) - viewer_page.at_rest(side, 0)
    pixels = np.arange(96 * 96)
    scene, light = FittedModel.load(model).scene(), [lighting.lights[side]]
    expected = render_indirect(scene, camera, light, pixels, spp=192, max_depth=24)
    expected = expected.reshape(96, 96, 3)
    np.testing.assert_allclose(found.sum(axis=(0, 1)), expected.sum(axis=(0, 1)), rtol=0.1)
    assert np.corrcoef(found.ravel(), expected.ravel())[0, 1] > 0.85
    for flipped in (expected[::-1], expected[:, ::-1]):
        assert np.corrcoef(found.ravel(), flipped.ravel())[0, 1] < 0.8
    assert viewer_page.complaints == []


@pytest.mark.parametrize("model", ["fibre"], indirect=True)
def test_the_truth_has_its_own_colours_in_whatever_exposure_the_model_is_lit(viewer_page, model):
    """In motion and at rest: directions are red, green and blue of the same brightness."""

    def shown() -> list[np.ndarray]:
        return [
            np.array(viewer_page.page.evaluate(SHOWN, rests), np.uint8) for rests in (False, True)
        ]

    viewer_page.drawn("viewer.relight")
    viewer_page.page.evaluate("() => { viewer.frame = () => {}; }")
    viewer_page.page.select_option("select >> nth=1", "truth")
    unlit = shown()
    viewer_page.page.select_option("select >> nth=0", "lit")
    viewer_page.page.wait_for_function("viewer.relight.visibility", timeout=PATIENCE_MS)
    for exposure in (8, 0.1):
        viewer_page.page.evaluate(f"() => {{ viewer.picture.state.exposure = {exposure}; }}")
        for expected, found in zip(unlit, shown(), strict=True):
            assert expected.any()
            assert np.abs(found.astype(int) - expected).mean() < 1
    assert viewer_page.complaints == []


SHOWN = """(rests) => {
    const { picture, canvas } = viewer, gl = picture.gl, out = new Uint8Array(4 * 96 * 96);
    canvas.width = canvas.height = 96;
    picture.moving(viewer.view);
    while (rests && picture.samples < picture.enough())
        for (const _ of picture.oneSample(viewer.view));
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, 96, 96, gl.RGBA, gl.UNSIGNED_BYTE, out);
    return Array.from(out);
}"""


AT_REST = """async (ambient) => {
    const { picture, canvas, relight } = viewer;
    canvas.width = canvas.height = 96;
    relight.ambient = ambient;
    if (ambient) await relight.inView(picture.ofModel(viewer.view));
    picture.again();
    while (picture.samples < picture.enough()) for (const _ of picture.oneSample(viewer.view));
    return Array.from(picture.radiance());
}"""


def test_a_light_that_is_shaded_keeps_its_shadows_when_another_comes(viewer_page):
    """24 lights one after the other, then the first of them beside a new one."""
    values = viewer_page.page.evaluate(SHADE_25)
    assert values == {"error": "", "latest": [23, 0, 24], "size": 24}


SHADE_25 = """async () => {
    const { Relight } = await import("/view/page/relight.js");
    const hair = { count: 1, points: 1, none: {}, perPoint: () => ({}) };
    const gl = { deleteTexture() {} }, picture = { sets: { model: hair } };
    const relight = Object.create(Relight.prototype);
    Object.assign(relight, {
        viewer: { gl, picture, status() {}, draw() {} }, cache: new Map(),
    });
    const asked = window.fetch;
    let shaded, error = "";
    window.fetch = async (path, ...more) => {
        if (path.endsWith("/few")) return Response.json(shaded.map((number) => ({ number })));
        if (path.includes("/visibility/")) return new Response(new Uint8Array([1]));
        return asked(path, ...more);
    };
    try {
        for (let n = 0; n < 24; n++) { shaded = [n]; await relight.shade({}); }
        shaded = [0, 24];
        await relight.shade({});
    } catch (e) { error = e.message; }
    return { error, latest: [...relight.cache.keys()].slice(-3), size: relight.cache.size };
}"""
