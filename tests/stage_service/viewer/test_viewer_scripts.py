"""The page's scripts by themselves, without a browser: what they ask, and what they say."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest

from stage_service.api.viewing import FILES

NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="there is no Node.js here")
BROWSER = """
globalThis.location = { hash: "#model=m", search: "", pathname: "/view" };
globalThis.sessionStorage = { getItem: () => null };
globalThis.document = { getElementById: () => ({ decode() {} }) };
const said = [];
const viewer = { picture: { state: { exposure: 1 } }, status: (x) => said.push(x), draw() {} };
const { Relight } = await import("./relight.js");
const relight = Object.assign(Object.create(Relight.prototype), { viewer, data: { missing: {} } });
"""


@pytest.fixture
def run(tmp_path: Path) -> Any:
    """Runs a script beside the page's, which leaves what it found in `out`."""
    shutil.copytree(FILES, tmp_path / "page")
    (tmp_path / "page/package.json").write_text('{"type": "module"}')

    def ran(script: str) -> Any:
        file = tmp_path / "page/test.js"
        file.write_text(f"let out;\n{script}\nconsole.log(JSON.stringify(out));")
        done = subprocess.run(
            [str(NODE), str(file)], capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return ran


def test_frames_are_requested_by_any_camera_name(run):
    name = "cam #1, 50% left?"
    requested = run(
        BROWSER
        + f"""
        globalThis.fetch = async (path) => {{ out = path; return new Response("x"); }};
        await relight.showSum({json.dumps(name)}, {{}});"""
    )
    parts = urlsplit(requested)
    assert unquote(parts.path) == f"view/models/m/sums/{name}.png"
    assert (parts.query, parts.fragment) == ("", "")


def test_missing_frames_are_reported(run):
    said = run(
        BROWSER
        + """
        globalThis.fetch = async () => new Response("x");
        relight.data.missing = { a: 2 };
        for (const camera of ["b", "a"]) await relight.showSum(camera, {});
        out = said;"""
    )
    assert said[-3] == ""
    assert "2 frames of a are missing" in said[-1]


def test_the_latest_light_is_shown_though_one_before_it_failed(run):
    shown, said = run(
        BROWSER
        + """
        const shown = [];
        relight.apply = async () => {
          const { number } = relight.weights;
          await null;
          if (number === 1) throw new Error("no response");
          shown.push(number);
        };
        const first = relight.set({ number: 1 });
        relight.set({ number: 2 });
        await first;
        out = [shown, said];"""
    )
    assert shown == [2]
    assert said == ["no response"]


def test_a_camera_chosen_before_light_is_there_shows_its_frames(run):
    looked = run(
        BROWSER
        + """
        const { Controls } = await import("./controls.js");
        Relight.begin = async () => relight;
        relight.controls = () => [];
        const looked = [];
        viewer.picture.state.camera = { name: "left" };
        await Controls.prototype.light.call(
          { viewer, panel: { append() {} }, look: async (x) => looked.push(x) });
        out = looked;"""
    )
    assert looked == ["left"]


@pytest.mark.parametrize(
    ("there", "expected"),
    [
        (["EXT_color_buffer_float", "EXT_float_blend"], "RGBA32F"),
        (["EXT_color_buffer_float", "EXT_color_buffer_half_float"], "RGBA16F"),
        (["EXT_color_buffer_half_float"], "RGBA16F"),
        ([], "needs float textures"),
    ],
)
def test_pictures_are_added_up_in_what_the_card_can_blend(run, there, expected):
    """WebGL2 blends no 32-bit floats without EXT_float_blend, and draws none without a buffer."""
    found = run(
        f"""
        const gl = {{
          RGBA32F: "RGBA32F", RGBA16F: "RGBA16F", pixelStorei() {{}},
          getExtension: (name) => ({json.dumps(there)}.includes(name) ? {{}} : null),
        }};
        const {{ context }} = await import("./gl.js");
        try {{ out = context({{ getContext: () => gl }}).summed ?? "RGBA32F"; }}
        catch (error) {{ out = error.message; }}"""
    )
    assert expected in found
