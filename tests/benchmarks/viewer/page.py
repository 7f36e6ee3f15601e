"""A model in the viewer of a browser without a GPU, as `hairstage view` shows it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from appearance.bsdf.maps import HairMaps
from appearance.model.fitted_model import FittedModel
from benchmarks.browser import chromium
from benchmarks.subjects import Subject
from reconstruction import Camera, Light, Model
from reconstruction.arrays import Floats
from stage_service.cli.support.children import Children, own_command
from stage_service.viewer import Viewed

PATIENCE_MS = 600_000
SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")


class Shown:
    """The viewer's page, which draws when it is told."""

    def __init__(self, page: Any, model: Model) -> None:
        self.page, self.model = page, model

    def lights(self) -> list[Light]:
        """The lights that the page knows, by number."""
        return Viewed(self.model).lighting.lights

    def camera(self, size: int) -> Camera:
        """The page's view as a picture of `size` pixels a side."""
        values = self.page.evaluate(
            f"(() => {{ const {{ K, R, t }} = viewer.orbit.pinhole({size}, {size});"
            "return { K, R, t }; })()"
        )
        K, R, t = (np.array(values[k]) for k in "KRt")
        return Camera("orbit", size, size, K, R, t)

    def light(self, weights: Mapping[int, Any] | str) -> None:
        """Light the hair by lights (number: RGB), or by the environment of that name."""
        self.page.evaluate(LIGHT, weights if isinstance(weights, str) else dict(weights))

    def at_rest(self, size: int, over: int, samples: int, ambient: float | None = None) -> Floats:
        """The picture at rest `(size, size, 3)`, radiance: means of `over` x `over` pixels, each of
        at least so many `samples` and of all turns of its lights. `ambient` as the page's slider
        sets it."""
        values = self.page.evaluate(AT_REST, [size * over, samples, ambient])
        blocks = np.array(values, np.float32).reshape(size, over, size, over, 4)
        return np.asarray(blocks.mean((1, 3))[::-1, :, :3])


@contextlib.contextmanager
def viewers() -> Iterator[Callable[[Subject], contextlib.AbstractContextManager[Shown]]]:
    """Opens the viewer of one subject after another. Raises `LeftOut` without a browser."""
    with chromium() as launch:

        @contextlib.contextmanager
        def opened(subject: Subject) -> Iterator[Shown]:
            with TemporaryDirectory() as folder, Children(Path(folder) / "logs") as children:
                model = Model(Path(folder) / "model")
                _write(subject, model)
                words = own_command("view", model.path, "--json")
                url = children.ready("view", words, PATIENCE_MS / 1e3)["url"]
                browser = launch(*SOFTWARE)
                try:
                    page = browser.new_page(
                        viewport={"width": 1024, "height": 1024}, bypass_csp=True
                    )
                    page.set_default_timeout(PATIENCE_MS)
                    page.goto(url)
                    page.wait_for_function("window.viewer?.complete && viewer.relight")
                    page.evaluate(PREPARE)
                    yield Shown(page, model)
                finally:
                    browser.close()

        yield opened


def _write(subject: Subject, model: Model) -> None:
    """A model as if its fit had found the truth."""
    model.create().write_strands(subject.strands)
    found = replace(FittedModel.unfitted(model), head=subject.head).with_maps(
        HairMaps.of(subject.hair)
    )
    replace(found, appearance=replace(found.appearance, skin=subject.skin)).save(model)


PREPARE = """async () => {
    viewer.frame = () => {};
    document.body.style.gridTemplateColumns = "1fr";
    document.getElementById("panel").hidden = true;
    await viewer.relight.material();
    viewer.picture.state.mode = "lit";
}"""

LIGHT = """async (what) => {
    const { relight } = viewer;
    if (typeof what !== "string") await relight.set(what);
    else {
        const net = await import("/view/page/net.js");
        await relight.environment(() => net.json(net.ofModel(`/environments/${what}`)));
    }
}"""

AT_REST = """async ([size, least, ambient]) => {
    const { picture, canvas, relight, gl } = viewer, before = relight.ambient;
    canvas.width = canvas.height = size;
    relight.ambient = ambient ?? before;
    await relight.inView(picture.ofModel(viewer.view));
    picture.again();
    const cycle = picture.cycle();
    const enough = cycle * Math.max(Math.ceil(least / cycle), relight.turns());
    while (picture.samples < enough) {
        for (const _ of picture.oneSample(viewer.view)) gl.finish();
        await new Promise((done) => setTimeout(done));
    }
    relight.ambient = before;
    return Array.from(picture.radiance());
}"""
