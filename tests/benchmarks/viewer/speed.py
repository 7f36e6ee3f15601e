"""How fast the viewer draws in a browser without a GPU, and what its shader costs."""

from __future__ import annotations

import json
import os
from typing import Any

from benchmarks.browser import browser_cpu_s
from benchmarks.viewer.page import Shown

SIZE = 1024
CATEGORIES = ["devtools.timeline", "disabled-by-default-devtools.timeline.frame"]
FRAME = "DrawFrame"
"""What Chromium's tracing calls a frame that its compositor has drawn."""


def measure(shown: Shown, seconds: float) -> dict[str, Any]:
    """Frames a second while the model turns, by Chromium's tracing: with all strands, lit and by
    direction, and with as many as the page itself draws when it is slow. Processor seconds of all
    the browser's processes for a frame of each."""
    page = shown.page
    page.evaluate(SIZED, SIZE)
    shown.light({0: [1, 1, 1]})
    found: dict[str, Any] = {"load_average": os.getloadavg()[0], "cores": os.cpu_count()}
    for name, mode, paced in (
        ("line", "direction", False),
        ("lit", "lit", False),
        ("paced", "lit", True),
    ):
        page.evaluate(TURN, [mode, paced, 0.5])  # the first frames compile
        page.context.browser.start_tracing(page=page, categories=CATEGORIES)
        before = browser_cpu_s()
        measured = page.evaluate(TURN, [mode, paced, seconds])
        browser_s = browser_cpu_s() - before
        events = json.loads(page.context.browser.stop_tracing())["traceEvents"]
        drawn = sum(e["name"] == FRAME for e in events)
        found[name] = {
            "frames_a_second": drawn / measured["seconds"],
            "pictures_a_second": measured["frames"] / measured["seconds"],
            "cpu_s_each": browser_s / max(measured["frames"], 1),
            "strands_share": measured["quality"],
        }
    found["shader_over_line"] = found["lit"]["cpu_s_each"] / found["line"]["cpu_s_each"]
    return found


SIZED = """(size) => {
    viewer.resize = () => {};
    viewer.canvas.width = viewer.canvas.height = size;
}"""

# Turns as a hand does: a step a frame, a new picture when the last one is done.
TURN = """([mode, paced, seconds]) => new Promise((done) => {
    const { picture, orbit } = viewer, began = performance.now();
    picture.state.mode = mode;
    if (!paced) picture.state.quality = 1;
    let frames = 0;
    const step = (now) => {
        const spent = (now - began) / 1e3;
        if (picture.ready()) {
            if (spent > seconds && frames > 1)
                return done({ frames, seconds: spent, quality: picture.state.quality });
            if (paced && frames) viewer.adaptQuality(picture.took);
            orbit.turn(2, 0);
            picture.moving(viewer.view);
            frames++;
        }
        requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
})"""
