"""Curves, black levels and lamps recovered from a set whose fully lit frame is a sum of lights."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from reconstruction import Capture
from reconstruction.capture.import_folder import Import
from reconstruction.capture.import_settings import ImportSettings, Patterns
from reconstruction.capture.response_check import ResponseCheck
from reconstruction.files.pictures import Sensor
from stage_service.cli import main

WIDTH, HEIGHT, LIGHTS = 160, 128, 16
LIT_LEVEL = 0.25  # all lights together are dimmed


def lights(seed: int = 3) -> Any:
    """Radiance `(N, H, W, 3)` of a bumpy glossy sphere, from dark to bright, under each light."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    u, v = (x - WIDTH / 2) / (0.45 * HEIGHT), (y - HEIGHT / 2) / (0.45 * HEIGHT)
    normal = np.stack([u, v, np.sqrt(np.maximum(1 - u * u - v * v, 0))], -1)
    normal += 0.25 * (np.sin(x / 5) * np.cos(y / 7))[..., None] * [1, 0.5, 0]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    albedo = 0.03 * 25.0 ** (x / WIDTH)[..., None] * [1, 0.8, 0.6]
    towards = rng.normal(size=(LIGHTS, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    out = []
    for light in towards:
        half = light + np.array([0, 0, 1])
        gloss = np.maximum(normal @ half / np.linalg.norm(half), 0) ** 60
        matt = np.maximum(normal @ light, 0)[..., None] * albedo
        out.append((matt + 0.3 * gloss[..., None]) * ((u * u + v * v) < 1)[..., None] + 0.004)
    singles = np.array(out)
    return singles / np.quantile(singles.sum(axis=0), 0.98) / LIT_LEVEL


def encoded(light: Any, curve: Any) -> Any:
    if curve == "srgb":  # IEC 61966-2-1
        power = 1.055 * np.maximum(light, 1e-12) ** (1 / 2.4) - 0.055
        return np.where(light <= 0.0031308, 12.92 * light, power)
    return np.maximum(light, 0) ** (1 / curve)


def shoot(
    root: Path, singles: Any, lit: Any, curve: Any, bits: int = 8, black: float = 0.0,
    noise: float = 0.004,
) -> None:  # fmt: skip
    """A folder to import; values above white are clipped."""
    rng, top = np.random.default_rng(7), 2**bits - 1
    (root / "images" / "cam").mkdir(parents=True)
    names = [*(f"light_{i:02d}" for i in range(len(singles))), "all"]
    for name, light in zip(names, [*singles, lit], strict=True):
        value = encoded(light, curve) * (1 - black) + black + noise * rng.normal(size=light.shape)
        counts = np.rint(np.clip(value, 0, 1) * top).astype(np.uint8 if bits == 8 else np.uint16)
        cv2.imwrite(str(root / "images" / "cam" / f"{name}.png"), counts[..., ::-1])
    K = [[300, 0, WIDTH / 2 - 0.5], [0, 300, HEIGHT / 2 - 0.5], [0, 0, 1]]
    pose = {"K": K, "R": np.eye(3).tolist(), "t": [0, 0, 1]}
    camera = {"id": "cam", "width": WIDTH, "height": HEIGHT, **pose}
    (root / "cameras.json").write_text(json.dumps({"cameras": [camera]}))
    entries = [
        {"id": i, "position": [0.1 * i, 0, -1], "intensity": [1, 1, 1]} for i in range(len(singles))
    ]
    (root / "lights.json").write_text(json.dumps({"lights": entries}))


def check(root: Path, response: Any = None, white: float | None = None) -> ResponseCheck:
    patterns = Patterns(all_on="images/{camera}/all.png")
    sensor = Sensor(response=response, white=white)
    return Import.of(root, settings=ImportSettings(patterns, sensor)).response


@pytest.mark.parametrize(
    ("curve", "bits", "black", "noise"),
    [
        (1.0, 8, 0.0, 0.004), (1.0, 12, 0.0625, 0.002), (1.8, 10, 0.02, 0.002),
        (2.2, 8, 0.03, 0.004), ("srgb", 8, 0.0, 0.004), ("srgb", 16, 0.0, 0.001),
    ],
)  # fmt: skip
def test_curve_and_black_level_are_recovered(
    curve: Any, bits: int, black: float, noise: float, tmp_path: Path
) -> None:
    """A wrong curve is replaced if nobody stated it; clipped highlights are in every set."""
    singles, top = lights(), 2**bits - 1
    shoot(tmp_path / "set", singles, LIT_LEVEL * singles.sum(axis=0), curve, bits, black, noise)
    white = None if bits in (8, 16) else float(top)
    found = check(tmp_path / "set", None, white)
    assumed = {True: "srgb", False: 1.0}[bits == 8]
    response = found.sensor.response if found.sensor.response is not None else assumed
    response = 1.0 if response == "linear" else response
    if curve == "srgb":
        assert response == "srgb"
    else:
        assert response == pytest.approx(curve, rel=0.02)
    assert (found.sensor.black or 0.0) / top == pytest.approx(black, abs=0.004)
    said = "is confirmed" if (assumed, 0.0) == (curve, black) else "are used instead"
    assert said in found.notes[0]
    assert len(found.notes) == 1


@pytest.mark.slow
def test_a_stated_curve_is_kept_and_contradicted(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    singles = lights()
    root = tmp_path / "set"
    shoot(root, singles, LIT_LEVEL * singles.sum(axis=0), 2.2)
    found = check(root, "srgb")
    assert found.sensor == Sensor(response="srgb")
    assert "contradict sRGB with black 0, which is used as stated: set" in found.notes[0]
    assert "sensor.response = 2.2 " in found.notes[0] or "= 2.19 " in found.notes[0]
    assert "gamma 2.2 is confirmed" in check(root, 2.2).notes[0]
    # by the command, without a statement: frames are decoded with the curve of the set
    (root / "import.toml").write_text('[pictures]\nall_on = "images/{camera}/all.png"\n')
    assert main(["import", str(root), "--out", str(tmp_path / "capture"), "--json"]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert any("are used instead" in n for n in notes)
    capture = Capture(tmp_path / "capture")
    frame = capture.frame(capture.of_kind("olat")[5], "cam")
    dark = (singles[5] > 0.01) & (singles[5] < 0.05)  # sRGB's curve is up to 1.6 times off here
    assert np.median(frame[dark] / singles[5][dark]) == pytest.approx(1, abs=0.05)


def test_levels_of_single_lights(tmp_path: Path) -> None:
    """A single light exposed twice as long, one dark in its frame, one missing from the sum."""
    singles = lights()
    lit = LIT_LEVEL * singles.sum(axis=0)
    longer = singles.copy()
    longer[3] *= 2
    shoot(tmp_path / "longer", longer, lit, 2.2)
    notes = check(tmp_path / "longer").notes
    assert [n for n in notes if n.startswith("light_03: the fully lit frame has 0.")] == [notes[1]]
    assert "gamma 2.2" in notes[0]
    shoot(tmp_path / "missing", singles, lit - LIT_LEVEL * singles[2], 2.2)
    notes = check(tmp_path / "missing").notes
    assert notes[1].startswith("light_02: the fully lit frame has 0.0")
    assert len(notes) == 2
    dead = singles.copy()
    dead[7] = 0
    shoot(tmp_path / "dead", dead, lit, 2.2)
    assert "no light under light_07" in check(tmp_path / "dead").notes[1]


def test_frames_that_determine_no_curve(tmp_path: Path) -> None:
    singles = lights()
    shoot(tmp_path / "even", np.repeat(singles[:1], 4, axis=0), singles[0], 2.2)
    assert "to check the curve" in check(tmp_path / "even").notes[0]
    shoot(tmp_path / "other", singles[:4], LIT_LEVEL * singles[4:].sum(axis=0), 2.2)
    found = check(tmp_path / "other")
    assert "differ from the sum of the single lights" in found.notes[0]
    assert found.sensor == Sensor()
    (tmp_path / "other" / "images" / "cam" / "all.png").unlink()
    assert "no fully lit frame" in check(tmp_path / "other").notes[0]
