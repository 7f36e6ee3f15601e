"""Worlds that are not as a user believes: each comes out right, is refused with the way on, or is
warned of.

The subject is lumps of the size of a head, matte and asymmetric, with hair from its ears upwards;
its volume is known.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from reconstruction import Camera, Capture, Light, Strands, write_exr
from reconstruction.capture.import_folder import Import
from reconstruction.capture.import_settings import ImportSettings
from reconstruction.capture.records import CaptureError
from reconstruction.geometry.lights import dome_positions
from reconstruction.growth.hair_envelope import build_hull
from reconstruction.head.generic import generic_head
from reconstruction.images.scene_checks import check_scene
from reconstruction.masks import MaskedCapture, hair_masks, usable_masks
from reconstruction.options import parse_options
from reconstruction.plausibility import check_face, check_strands
from reconstruction.report.report import Stage

BALLS = (([0, 0, 0], 0.1), ([0.07, 0.02, 0.05], 0.06), ([-0.03, 0.07, -0.06], 0.06))
OTHER = (([0.26, 0.0, 0.0], 0.09),)
SIZE, GRID = 64, 5e-3
HAIR_FROM = 0.02
"""Metres above the origin."""
MIRROR = -0.2
"""Metres along x at which the mirror stands."""


@dataclass
class World:
    """A folder as its user has it."""

    balls: Sequence[Any] = BALLS
    scale: float = 1.0
    wall: float = 0.0
    hair: Callable[[np.ndarray], np.ndarray] = lambda points: points[..., 2] > HAIR_FROM
    cameras: list[dict[str, Any]] = field(default_factory=list)
    lights: list[dict[str, Any]] = field(default_factory=list)
    distance: float = 0.9
    mirror: bool = False

    def __post_init__(self) -> None:
        self.rig = []
        for k in range(7):
            a = 0.85 * k
            eye = [np.cos(a), np.sin(a), 0.5 * np.sin(1.7 * k)]
            eye = self.distance * np.array(eye)
            width = 30 if self.balls is BALLS and not self.mirror else 46
            self.rig.append(Camera.look_at(f"cam_{k}", SIZE, SIZE, eye, (0, 0, 0), width))
        self.lamps = [
            Light(f"led_{k}", p, np.ones(3)) for k, p in enumerate(dome_positions(24, 1.2, -60.0))
        ]

    def entries(self, by: float = 1.0, turn: Any = None) -> None:
        """Cameras and lights of the files: in 1/`by` metres, in axes turned by `turn`."""
        turn = np.eye(3) if turn is None else np.array(turn, float)
        for c in self.rig:
            one = {"id": c.name, "width": SIZE, "height": SIZE, "K": c.K.tolist()}
            self.cameras.append(one | {"R": (c.R @ turn.T).tolist(), "t": (by * c.t).tolist()})
        for x in self.lamps:
            place = (by * turn @ x.position).tolist()
            self.lights.append({"id": x.name, "position": place, "intensity": [1, 1, 1]})

    def write(self, folder: Path) -> Path:
        if not self.cameras:
            self.entries()
        folder.mkdir(parents=True)
        (folder / "cameras.json").write_text(json.dumps({"cameras": self.cameras}))
        (folder / "lights.json").write_text(json.dumps({"lights": self.lights}))
        (folder / "masks").mkdir()
        for camera in self.rig:
            (folder / "images" / camera.name).mkdir(parents=True)
            points, normals, hit = self.hits(camera)
            is_hair = hit & self.hair(points)
            cv2.imwrite(str(folder / "masks" / f"{camera.name}.png"), is_hair * np.uint8(255))
            albedo = np.where(is_hair, 0.15, 0.5)
            for lamp in self.lamps:
                away = lamp.position - points
                far = np.linalg.norm(away, axis=-1)
                facing = np.maximum((away * normals).sum(axis=-1) / far, 0)
                light = np.where(hit, albedo * facing / far**2, 0)
                bright = float(np.quantile(light[hit], 0.95))
                light = np.where(hit, light, self.wall * bright)
                image = np.repeat(light[..., None], 3, axis=2).astype(np.float32)
                write_exr(folder / "images" / camera.name / f"{lamp.name}.exr", image)
        return folder

    def hits(self, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points, normals `(H, W, 3)` and which pixels meet a ball, also one in the mirror."""
        x, y = np.meshgrid(np.arange(SIZE), np.arange(SIZE))
        rays = camera.rays(np.stack([x, y], axis=-1))
        direct = self._met(camera.center, rays)
        if not self.mirror:
            return direct
        flip = np.array([-1.0, 1, 1])
        reflected = self._met(camera.center * flip + [2 * MIRROR, 0, 0], rays * flip)
        to_mirror = (MIRROR - camera.center[0]) / rays[..., :1]
        at = camera.center + to_mirror * rays
        framed = (to_mirror[..., 0] > 0) & (np.abs(at[..., 1:]) < 0.5).all(axis=-1)
        instead = framed & (camera.center[0] > MIRROR) & ~direct[2] & reflected[2]
        points, normals = (
            np.where(instead[..., None], r, d)
            for r, d in zip(reflected[:2], direct[:2], strict=True)
        )
        return points, normals, direct[2] | instead

    def _met(self, eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        depth, normal = np.full(rays.shape[:2], np.inf), np.zeros(rays.shape)
        for center, radius in self.balls:
            towards = self.scale * np.array(center) - eye
            along = rays @ towards
            inside = along**2 - (towards @ towards - (self.scale * radius) ** 2)
            t = along - np.sqrt(np.maximum(inside, 0))
            nearer = (inside > 0) & (t > 0) & (t < depth)
            depth[nearer] = t[nearer]
            p = eye + t[..., None] * rays
            normal[nearer] = ((p - self.scale * np.array(center)) / (self.scale * radius))[nearer]
        hit = np.isfinite(depth)
        return eye + np.where(hit, depth, 0)[..., None] * rays, normal, hit


@dataclass
class Outcome:
    """What a user reads, and what is made of it."""

    notes: list[str]
    capture: Capture
    litres: float
    warnings: list[str]
    figures: dict[str, Any]


def outcome(folder: Path, **placement: Any) -> Outcome:
    """The import, and the reconstruction up to its hull. Raises `ValueError`."""
    settings = parse_options(ImportSettings, {"geometry": {"placement": placement}})
    read = Import.of(folder, None, settings)
    capture = read.write(folder.with_name("capture"))
    notes = [*capture.plan["import"]["notes"], *check_scene(capture)]
    stage = Stage("masks")
    masked = MaskedCapture(capture, usable_masks(capture, hair_masks(capture), stage))
    build_hull(masked, grid=GRID, stage=stage)
    return Outcome(notes, capture, stage.figures["hull_litres"], stage.warnings, stage.figures)


@pytest.fixture(scope="module")
def usual(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """The world as it is believed to be."""
    return outcome(World().write(tmp_path_factory.mktemp("usual") / "folder"))


def test_the_usual_world_is_not_doubted(usual: Outcome) -> None:
    assert [n for n in usual.notes if not n.startswith(("relative units", "no fully lit"))] == []
    assert [w for w in usual.warnings if not w.startswith("no head")] == []
    assert 4.5 < usual.litres < 8.0  # the balls have 5.6 together, less what they share
    assert min(usual.figures["mask_covered"].values()) > 0.95


def swapped(world: World) -> None:
    world.entries()
    first, second = world.cameras[1], world.cameras[4]
    first["id"], second["id"] = second["id"], first["id"]


def named_twice(world: World) -> None:
    world.entries()
    world.cameras[2]["id"] = world.cameras[1]["id"]


def no_right_hand(world: World) -> None:
    world.entries(turn=np.diag([-1.0, 1, 1]))


def mirrored_lights(world: World) -> None:
    world.entries()
    for light in world.lights:
        light["position"][0] *= -1


def light_inside(world: World) -> None:
    world.entries()
    world.lights[3]["position"] = [0.01, 0.0, 0.02]


def light_below(world: World) -> None:
    world.entries()
    world.lights[3]["position"] = [0.0, 0.08, -0.04]


BAD: dict[str, tuple[Callable[[World], None], str]] = {
    "millimetres": (lambda w: w.entries(1000.0), "give --unit"),
    "centimetres that pass for metres": (lambda w: None, "check the scale"),
    "mirrored axes": (no_right_hand, "rotation"),
    "two cameras of one name": (named_twice, "duplicate 'cam_1'"),
    "no hair": (lambda w: None, "no pixel of any camera is hair"),
    "a light in the middle": (light_inside, "led_3: within 5 cm of the point"),
    "a light in the subject": (light_below, "led_3: inside the subject"),
    "a wall as bright as skin": (lambda w: None, "reach all edges of their images"),
}
CHANGED = {
    "centimetres that pass for metres": {"scale": 3.0, "distance": 2.7},
    "no hair": {"hair": lambda points: np.zeros(points.shape[:2], bool)},
    "a wall as bright as skin": {"wall": 0.8},
}


def _fast(names: Iterable[str], *fast: str) -> list[Any]:
    """All `names`, each but the `fast` ones as a slow test."""
    return [n if n in fast else pytest.param(n, marks=pytest.mark.slow) for n in names]


@pytest.mark.parametrize("name", _fast(BAD, "millimetres", "mirrored axes"))
def test_a_world_that_cannot_be_is_refused_with_the_way_on(name: str, tmp_path: Path) -> None:
    change, said = BAD[name]
    world = World(**CHANGED.get(name, {}))
    change(world)
    with pytest.raises(CaptureError, match=said):
        outcome(world.write(tmp_path / "folder"))


DOUBTED: dict[str, tuple[Callable[[World], None], dict[str, Any], str]] = {
    "y up": (lambda w: w.entries(turn=[[1, 0, 0], [0, 0, 1], [0, -1, 0]]), {}, "give --up y"),
    "swapped cameras": (swapped, {}, "images or poses exchanged"),
    "mirrored lights": (mirrored_lights, {}, "the lights' axes do not fit"),
    "a second person": (lambda w: None, {"balls": BALLS + OTHER}, "2 separate parts"),
    "a patch": (lambda w: None, {"scale": 0.25, "distance": 0.3}, "no patch or tuft"),
}


@pytest.mark.parametrize("name", _fast(DOUBTED, "a second person"))
def test_a_world_that_may_be_is_warned_of(name: str, tmp_path: Path) -> None:
    change, fields, said = DOUBTED[name]
    world = World(**fields)
    change(world)
    folder = world.write(tmp_path / "folder")
    found = outcome(folder)
    assert said in " ".join([*found.notes, *found.warnings])


@pytest.mark.parametrize(
    ("by", "turn", "placement"),
    [
        pytest.param(1000.0, None, {"unit": "mm"}, marks=pytest.mark.slow),
        (100.0, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], {"unit": "cm", "up": "y"}),
    ],
)
def test_a_world_that_is_named_comes_out_right(
    by: float, turn: Any, placement: dict[str, Any], tmp_path: Path, usual: Outcome
) -> None:
    world = World()
    world.entries(by, turn)
    found = outcome(world.write(tmp_path / "folder"), **placement)
    assert found.litres == pytest.approx(usual.litres, rel=1e-3)
    for camera in found.capture.rig.cameras:
        np.testing.assert_allclose(camera.t, usual.capture.rig.camera(camera.name).t, atol=1e-9)


def test_a_light_that_is_missing_is_named(tmp_path: Path, usual: Outcome) -> None:
    folder = World().write(tmp_path / "folder")
    for path in (folder / "images").glob("*/led_5.exr"):
        path.unlink()
    lights = json.loads((folder / "lights.json").read_text())
    lights["lights"] = [x for x in lights["lights"] if x["id"] != "led_9"]
    (folder / "lights.json").write_text(json.dumps(lights))
    found = outcome(folder)
    said = " ".join(found.notes)
    assert "1 lights have no image and are skipped: led_5" in said
    assert "7 images match no pattern: images/cam_0/led_9.exr" in said
    assert found.litres == pytest.approx(usual.litres, rel=1e-3)


@pytest.mark.parametrize("wall", [0.03, pytest.param(0.1, marks=pytest.mark.slow)])
def test_a_lit_wall_is_no_part_of_the_head(wall: float, tmp_path: Path, usual: Outcome) -> None:
    found = outcome(replace(World(), wall=wall).write(tmp_path / "folder"))
    assert found.litres == pytest.approx(usual.litres, rel=0.03)
    assert found.warnings == usual.warnings


@pytest.mark.slow
def test_what_a_mirror_shows_is_no_part_of_the_head(tmp_path: Path, usual: Outcome) -> None:
    found = outcome(World(mirror=True).write(tmp_path / "folder"))
    assert found.litres == pytest.approx(usual.litres, rel=0.05)
    (doubt,) = [w for w in found.warnings if "do not meet in space" in w]
    assert "cam_1 58%, cam_6 59%" in doubt
    assert "a mirror" in doubt


def test_strands_are_held_against_a_head() -> None:
    def said(strands: Strands, area: float | None = None) -> str:
        stage = Stage("strands")
        check_strands(strands, area, stage)
        return " ".join(stage.warnings)

    line = np.linspace([0, 0, 0], [0, 0, 0.2], 2)
    assert said(Strands.from_list([line] * 100)) == ""
    assert "have 1 cm" in said(Strands.from_list([line / 20] * 100))
    assert "have 3e+02 cm" in said(Strands.from_list([line * 15] * 100))
    assert "more than the 30 hairs (6 m) of 0 cm²" in said(Strands.from_list([line] * 100), 1e-5)


def test_hair_before_the_face_is_noticed() -> None:
    head, stage = generic_head(), Stage("roots")
    top, front = head.vertices[:, 2].max(), head.vertices[:, 1].min()
    curtain = [[x, front, top - 0.13 - z] for x in (-0.02, 0.02) for z in (0, 0.06)]
    check_face(Strands.from_list([np.array(curtain)]), head, stage)
    assert stage.figures["before_face"] == 1
    assert "in front of the face" in stage.warnings[0]
    clear = Stage("roots")
    check_face(Strands.from_list([np.array(curtain) * [1, -1, 1]]), head, clear)
    assert (clear.figures["before_face"], clear.warnings) == (0, [])
