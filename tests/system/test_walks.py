"""Walks from a folder of files to strands in another program, typed as the pages print them.

What a user adds to a command is named by the page or by the command's own error.
"""

from __future__ import annotations

import json
import re
import shlex
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import camera_writers as writers
import cv2
import numpy as np
import pytest
import users_cameras as readers
from dng_writer import BLACK, RGGB, WHITE, write_dng
from pxr import Usd, UsdGeom
from scipy.spatial.transform import Rotation

from reconstruction import Camera, Capture, Model, write_exr
from reconstruction.geometry.lights import dome_positions
from stage_service.cli import main

ROOT = Path(__file__).parents[2]
PAGES = "\n".join(
    (ROOT / name).read_text().replace("\\\n", " ")
    for name in (
        "README.md", "docs/tutorials/photographs_to_blender.md",
        "docs/how-to/import.md", "docs/how-to/export.md",
    )
)  # fmt: skip
RADIUS = 0.1
AT = np.array([0.31, -0.22, 1.58])
"""Where the ball is in the user's world: metres, z up."""
FULL = 0.16
"""The light at which a channel is full: some highlights are above it."""
Y_UP, Y_DOWN = (np.array([[1, 0, 0], [0, 0, s], [0, -s, 0.0]]) for s in (1, -1))
"""From z up to the files' axes."""


def met(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Points `(H, W, 3)` of the ball about its centre, and which pixels meet it."""
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    rays, eye = camera.rays(grid), camera.center - AT
    b = rays @ eye
    inside = b**2 - (eye @ eye - RADIUS**2)
    return eye + (-b - np.sqrt(np.maximum(inside, 0)))[..., None] * rays, inside > 0


def photograph(camera: Camera, light: np.ndarray) -> np.ndarray:
    """A ball of fibres that run from pole to pole, after Kajiya and Kay, `(H, W, 3)`."""
    p, inside = met(camera)
    rays = p + AT - camera.center
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    n = p / RADIUS
    tangent = np.cross(np.cross(n, [0, 0, 1.0]), n)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=-1, keepdims=True), 1e-9)
    away = light - AT - p
    far = np.linalg.norm(away, axis=-1, keepdims=True)
    to = away / far
    along, towards_eye = (tangent * to).sum(axis=-1), -(tangent * rays).sum(axis=-1)
    shine = np.exp(-(((along + towards_eye) / 0.2) ** 2))
    phi = np.arctan2(p[..., 1], p[..., 0])
    fibres = 1 + 0.35 * np.cos(60 * phi) + 0.25 * np.cos(97 * phi + 1)
    facing = np.maximum((n * to).sum(axis=-1), 0) / far[..., 0] ** 2
    lit = (0.1 * np.sqrt(np.maximum(1 - along**2, 0)) + 0.2 * shine) * fibres * facing
    return np.where(inside, lit, 0)[..., None] * np.array([1.0, 0.7, 0.45])


@dataclass
class Shoot:
    """Cameras and lights about the ball, and what is photographed; `axes` and `unit` of the files.

    The user's masks have the hair `hair_above` the ball's centre, if that is not all of it.
    """

    names: list[str]
    count: int = 64
    size: int = 56
    axes: np.ndarray = field(default_factory=lambda: np.eye(3))
    unit: float = 1.0
    hair_above: float = -RADIUS

    def __post_init__(self) -> None:
        rng = np.random.default_rng(0)
        self.lights = AT + dome_positions(self.count, 1.2, -50.0)
        self.cameras = []
        for k, name in enumerate(self.names):
            a = 2 * np.pi * k / len(self.names)
            eye = AT + np.array([0.9 * np.sin(a), -0.9 * np.cos(a), (0.1, 0.4)[k % 2]])
            self.cameras.append(Camera.look_at(name, self.size, self.size, eye, AT, 15.0))
        self._noise = rng

    @property
    def of_files(self) -> list[Camera]:
        """The cameras in the files' axes and unit."""
        turned = [(c, c.R @ self.axes.T) for c in self.cameras]
        return [replace(c, R=R, t=-R @ self.to_files(c.center)) for c, R in turned]

    def to_files(self, points: np.ndarray) -> np.ndarray:
        return points @ self.axes.T / self.unit

    def picture(self, camera: Camera, lights: np.ndarray | None = None) -> np.ndarray:
        """Shares of a full channel `(H, W, 3)` under `lights (L, 3)`, by default all; noisy."""
        lights = self.lights if lights is None else lights
        light = sum(photograph(camera, x) for x in lights) / FULL
        return np.clip(light + self._noise.normal(0, 2e-3, light.shape), 0, 1)

    def hair(self, camera: Camera) -> np.ndarray:
        """Which pixels `(H, W)` show the ball above `hair_above`."""
        p, inside = met(camera)
        return inside & (p[..., 2] > self.hair_above)

    def write_masks(self, folder: Path) -> None:
        if self.hair_above == -RADIUS:
            return
        (folder / "masks").mkdir()
        for camera in self.cameras:
            mask = 255 * self.hair(camera).astype(np.uint8)
            assert cv2.imwrite(str(folder / "masks" / f"{camera.name}.png"), mask)

    def write(self, put: Callable[[Camera, int, np.ndarray], None]) -> None:
        """Each picture, but for one in twenty, which are lost."""
        for camera in self.cameras:
            for i, light in enumerate(self.lights):
                image = self.picture(camera, light[None])
                if self._noise.random() > 0.05:
                    put(camera, i, image)

    def lights_csv(self, header: str = "name,x,y,z", name: str = "led_{:03d}") -> str:
        places = self.to_files(self.lights).tolist()
        rows = [f"{name.format(i)},{x:.5f},{y:.5f},{z:.5f}" for i, (x, y, z) in enumerate(places)]
        return "\n".join([header, *rows]) + "\n"


def put_png(folder: Path, name: str, camera: Camera, i: int, image: np.ndarray) -> None:
    """16 bits, linear."""
    path = folder / "images" / camera.name / name.format(i)
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.round(image[..., ::-1] * 65535).astype(np.uint16))


def exr_and_json(folder: Path, shoot: Shoot) -> None:
    entries = [
        {"id": c.name, "width": c.width, "height": c.height}
        | {k: np.asarray(getattr(c, k)).tolist() for k in ("K", "R", "t", "distortion")}
        for c in shoot.of_files
    ]
    (folder / "cameras.json").write_text(json.dumps({"cameras": entries}))
    places = shoot.to_files(shoot.lights).tolist()
    lights = [{"id": i, "position": p, "intensity": [1, 1, 1]} for i, p in enumerate(places)]
    (folder / "lights.json").write_text(json.dumps({"lights": lights}))
    shoot.write_masks(folder)

    def put(camera: Camera, i: int, image: np.ndarray) -> None:
        path = folder / "images" / camera.name / f"light_{i:02d}.exr"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_exr(path, (FULL * image).astype(np.float32))

    shoot.write(put)


def png_and_colmap(folder: Path, shoot: Shoot) -> None:
    cameras, images = [], []
    for k, c in enumerate(shoot.of_files, 1):
        cx, cy = c.K[:2, 2] + 0.5
        cameras.append(f"{k} PINHOLE {c.width} {c.height} {c.K[0, 0]} {c.K[1, 1]} {cx} {cy}\n")
        x, y, z, w = Rotation.from_matrix(c.R).as_quat()
        t = " ".join(str(v) for v in c.t)
        images.append(f"{k} {w} {x} {y} {z} {t} {k} {c.name}/led_000.png\n\n")
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "sparse" / "0" / "cameras.txt").write_text("".join(cameras))
    (folder / "sparse" / "0" / "images.txt").write_text("".join(images))
    (folder / "lights.csv").write_text(shoot.lights_csv())
    shoot.write_masks(folder)
    shoot.write(partial(put_png, folder, "led_{:03d}.png"))


def raw_and_metashape(folder: Path, shoot: Shoot) -> None:
    writers.write_metashape(folder / "cameras.xml", shoot.of_files)
    (folder / "lights.csv").write_text(shoot.lights_csv("id,x_cm,y_cm,z_cm", "{}"))
    colours = np.array(RGGB).reshape(2, 2)

    def put(camera: Camera, i: int, image: np.ndarray) -> None:
        y, x = np.mgrid[: camera.height, : camera.width]
        share = image[y, x, colours[y % 2, x % 2]]
        path = folder / "images" / camera.name / f"light_{i}.dng"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_dng(path, np.round(BLACK + share * (WHITE - BLACK)))

    shoot.write(put)


def easymocap(folder: Path, shoot: Shoot) -> None:
    """intri.yml and extri.yml beside images/01/000000.png (chingswy/easymocap-public-doc)."""
    writers.write_easymocap(folder / "calib", shoot.of_files, sizes=False)
    for name in ("intri.yml", "extri.yml"):
        (folder / "calib" / name).rename(folder / name)
    (folder / "calib").rmdir()
    (folder / "lights.csv").write_text(shoot.lights_csv("id,x,y,z", "{}"))
    shoot.write(partial(put_png, folder, "{:06d}.png"))


def nerfstudio(folder: Path, shoot: Shoot) -> None:
    """A frame for each picture, as its own tools write them."""
    writers.write_transforms(folder / "transforms.json", shoot.of_files)
    data = json.loads((folder / "transforms.json").read_text())
    frames = [
        f | {"file_path": f["file_path"].replace(".png", f"/led_{i:03d}.png")}
        for f in data["frames"]
        for i in range(shoot.count)
    ]
    (folder / "transforms.json").write_text(json.dumps(data | {"frames": frames}))
    (folder / "lights.csv").write_text(shoot.lights_csv())
    shoot.write(partial(put_png, folder, "led_{:03d}.png"))


def faceolat(folder: Path, shoot: Shoot) -> None:
    """Frames in the order of the lights; the whole stage is lit in frames 0, 20, 41, …"""
    lit = {0, *range(20, shoot.count + shoot.count // 20 + 2, 21)}
    singles = iter(range(shoot.count))
    rows = [[i, 0 if i in lit else next(singles) + 1] for i in range(shoot.count + len(lit))]
    lights = folder.parent / "relighting" / "lights"
    lights.mkdir(parents=True)
    places = 1000 * shoot.to_files(shoot.lights)  # millimetres, the cameras in metres
    text = json.dumps({"light_positions": places.tolist()})
    (lights / "light_pattern_metadata.json").write_text(text)
    (lights / "light_pattern_per_frame.json").write_text(json.dumps(rows))
    calibration = folder.parent / "calibration" / "cameras"
    calibration.mkdir(parents=True)
    writers.write_metashape(calibration / "001.xml", shoot.of_files)
    for camera in shoot.cameras:
        take = folder / camera.name / "ID20001"
        take.mkdir(parents=True)
        for i, light in rows:
            image = shoot.picture(camera, shoot.lights[light - 1][None] if light else None)
            write_exr(take / f"ID20001.{i + 1:06d}.exr", (FULL * image).astype(np.float32))


def srgb(image: np.ndarray) -> np.ndarray:
    """8 bits."""
    curve = np.where(image > 0.0031308, 1.055 * image ** (1 / 2.4) - 0.055, 12.92 * image)
    return np.round(255 * curve[..., ::-1]).astype(np.uint8)


def humanolat(folder: Path, shoot: Shoot) -> None:
    """A pose of AVIF; white light, 13 gradients, then the single lights; cameras in mm."""
    shared, lit = folder.parent / "shared", (0, 20, 41, 62, 68)
    shared.mkdir()
    metres = [replace(c, t=shoot.unit * c.t) for c in shoot.of_files]
    writers.write_calib(shared / "cameras.calib", metres)
    rows = (shoot.unit * shoot.to_files(shoot.lights)).tolist()
    vertices = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in rows)
    (shared / "LSX_light_positions_aligned.pc").write_text(vertices)
    spiral = "".join(f"{i + 1}\n" for i in range(shoot.count))
    (shared / "LSX3_light_z_spiral.txt").write_text(spiral)
    masks = folder / "segmentations" / "masks" / "000"
    masks.mkdir(parents=True)
    for camera in shoot.cameras:
        taken = folder / "images_processed" / camera.name
        taken.mkdir(parents=True)
        cv2.imwrite(str(masks / f"{camera.name}.png"), 255 * met(camera)[1].astype(np.uint8))
        singles = iter(shoot.lights)
        for i in range(14 + shoot.count + len(lit)):
            whole = i < 14 or i - 14 in lit
            image = shoot.picture(camera, None if whole else next(singles)[None])
            best = [cv2.IMWRITE_AVIF_QUALITY, 100]
            assert cv2.imwrite(str(taken / f"C003.{i:06d}.avif"), srgb(image), best)


def openillumination(folder: Path, shoot: Shoot) -> None:
    frames = {}
    for camera in shoot.of_files:
        right, down, forward = camera.R
        matrix = np.eye(4)
        matrix[:3] = np.stack([right, -down, -forward, camera.center], axis=1)
        angle = 2 * np.arctan(camera.width / 2 / camera.K[0, 0])
        frames[camera.name] = {"camera_angle_x": angle, "transform_matrix": matrix.tolist()}
    (folder / "output" / "obj_masks").mkdir(parents=True)
    (folder / "output" / "transforms_train.json").write_text(json.dumps({"frames": frames}))
    np.save(folder.parent / "light_pos.npy", shoot.to_files(shoot.lights))
    for camera in shoot.cameras:
        mask = 255 * met(camera)[1].astype(np.uint8)
        cv2.imwrite(str(folder / "output" / "obj_masks" / f"{camera.name}.png"), mask)

    def put(camera: Camera, i: int, image: np.ndarray) -> None:
        path = folder / "Lights" / f"{i:03d}" / "raw_undistorted" / f"{camera.name}.JPG"
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), srgb(image))

    shoot.write(put)


@dataclass(frozen=True)
class Walk:
    """A folder: the documented command `shown` imports it, with the options that its errors `named`
    and those that the user has `measured`; if `fitted`, step 5 of the tutorial follows."""

    write: Callable[[Path, Shoot], None]
    pixels: Callable[[Path], readers.Pixels]
    shoot: Callable[[], Shoot]
    named: tuple[str, ...] = ()
    measured: str = ""
    fitted: bool = False
    shown: str = "hairstage import FOLDER --out capture"


NUMBERED = [f"{k + 1:02d}" for k in range(8)]
CAMS = [f"DSC_{k}" for k in range(8)]
WALKS = {
    "exr": Walk(
        exr_and_json, lambda f: readers.of_json(f / "cameras.json"),
        lambda: Shoot(CAMS[:6], 24, 48, hair_above=0.05),
    ),
    "colmap": Walk(
        png_and_colmap, lambda f: readers.of_colmap(f / "sparse/0"),
        lambda: Shoot(CAMS[:6], 24, 48, Y_DOWN, 1e-3, 0.05), ("--unit mm", "--up -y"),
    ),
    "raw": Walk(
        raw_and_metashape, lambda f: readers.of_metashape(f / "cameras.xml"),
        lambda: Shoot(CAMS, size=96),
    ),
    "easymocap": Walk(easymocap, readers.of_easymocap, lambda: Shoot(NUMBERED)),
    "nerfstudio": Walk(
        nerfstudio, lambda f: readers.of_nerfstudio(f / "transforms.json"),
        lambda: Shoot(CAMS, unit=0.37), measured="--unit 0.37", fitted=True,
    ),
    "faceolat": Walk(
        faceolat, lambda f: readers.of_metashape(f.parent / "calibration/cameras/001.xml"),
        lambda: Shoot([f"Cam{n}" for n in NUMBERED], axes=Y_UP),
        shown="hairstage import FOLDER --preset faceolat",
    ),
    "humanolat": Walk(
        humanolat, lambda f: readers.of_calib(f.parent / "shared/cameras.calib", 56),
        lambda: Shoot([f"Cam{n}" for n in NUMBERED], axes=Y_UP, unit=1e-3),
        measured="--preset humanolat",
    ),
    "openillumination": Walk(
        openillumination,
        lambda f: readers.of_openillumination([f / "output/transforms_train.json"], 56, 56),
        lambda: Shoot(["A1", "A2", "B3", "B4", "C5", "C6", "CE2", "CF8"], axes=Y_UP), ("--up y",),
        measured="--preset openillumination",
    ),
}  # fmt: skip
FAST = ("colmap",)


def printed(start: str) -> str:
    """The one command of the pages that begins so."""
    lines = re.findall(r"^ {4,}(hairstage .*?) *(?:#.*)?$", PAGES, re.M)
    return next(x for x in lines if x.startswith(start))


class Typed:
    """Commands as typed, with what they print and take."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys
        self.record: list[tuple[str, float]] = []

    def run(self, line: str) -> tuple[int, str]:
        started = time.monotonic()
        try:
            code = main(shlex.split(line)[1:])
        except SystemExit as end:
            code = int(end.code or 0)
        self.record.append((line, time.monotonic() - started))
        printed = self._capsys.readouterr()
        return code, printed.out + printed.err

    def done(self, line: str) -> str:
        code, text = self.run(line)
        assert code == 0, text
        return text

    def imported(self, line: str) -> tuple[str, list[str]]:
        """Repeat the import with the options that its errors name; returns these."""
        named: list[str] = []
        for _ in range(4):
            code, text = self.run(" ".join([line, *named]))
            if code == 0:
                return text, named
            option = re.search(r"give (--[a-z-]+ [-\w./]+)", text)
            assert option, text
            named.append(option[1])
        raise AssertionError(named)


def widened(mask: np.ndarray) -> np.ndarray:
    """By two pixels."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0


def polar_error(points: np.ndarray, counts: np.ndarray) -> float:
    """Median degrees between strands about the origin and the ball's meridians."""
    strand = np.repeat(np.arange(len(counts)), counts)
    same = strand[1:] == strand[:-1]
    p, along = points[:-1][same], np.diff(points, axis=0)[same]
    away = np.linalg.norm(p[:, :2], axis=1) > 0.04  # at the poles there is no direction
    n = p[away] / np.linalg.norm(p[away], axis=1, keepdims=True)
    truth = np.cross(np.cross(n, [0, 0, 1.0]), n)
    cosine = (truth * along[away]).sum(axis=1) / np.maximum(
        np.linalg.norm(truth, axis=1) * np.linalg.norm(along[away], axis=1), 1e-12
    )
    return float(np.median(np.degrees(np.arccos(np.clip(np.abs(cosine), 0, 1)))))


@pytest.mark.parametrize(
    "name", [n if n in FAST else pytest.param(n, marks=pytest.mark.slow) for n in WALKS]
)
def test_walk(
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    walk = WALKS[name]
    shoot = walk.shoot()
    (tmp_path / "FOLDER").mkdir()
    walk.write(tmp_path / "FOLDER", shoot)
    monkeypatch.chdir(tmp_path)
    typed = Typed(capsys)

    # the tutorial's steps 2 to 6
    line = " ".join([printed(walk.shown), walk.measured]).strip()
    said, named = typed.imported(f"{line} --dry-run")
    assert named == list(walk.named)
    assert "contact sheet" in said
    typed.done(" ".join([line, *named]))
    assert "seconds" in typed.done(printed("hairstage reconstruct capture --estimate"))
    typed.done(printed("hairstage reconstruct capture --out model"))
    if walk.fitted:
        typed.done(printed("hairstage fit capture model"))
    said = typed.done(printed("hairstage export model --to blender"))
    assert "open_in_blender.py" in said
    assert ("has no fit" in said) != walk.fitted
    typed.done(printed("hairstage export model --to usd"))

    # what Blender's script reads: metres, z up, where the ball is
    groom = np.load(tmp_path / "hair" / "groom.npz")
    points = groom["points"] - AT
    distance = np.linalg.norm(points, axis=1)
    assert len(groom["counts"]) > 100
    # the surface, and what is filled under it
    assert np.percentile(distance, 99) == pytest.approx(RADIUS, abs=8e-3)
    assert polar_error(points, groom["counts"]) < 10

    # USD by its own library: the user's frame and unit, on the user's pictures by the user's file
    opened = Usd.Stage.Open(str(tmp_path / "hair.usdc"))
    curves = next(UsdGeom.BasisCurves(p) for p in opened.Traverse() if UsdGeom.BasisCurves(p))
    stored = np.array(curves.GetPointsAttr().Get(), float)
    assert UsdGeom.GetStageMetersPerUnit(opened) == pytest.approx(shoot.unit)
    np.testing.assert_allclose(stored, shoot.to_files(groom["points"]), atol=1e-5 / shoot.unit)
    found = walk.pixels(tmp_path / "FOLDER")(stored[::8])  # 4 mm apart
    own = Model(tmp_path / "model").strands().points[::8]
    assert sorted(found) == sorted(shoot.names)
    rig = Capture(tmp_path / "capture").rig
    off = [np.abs(found[c] - rig.camera(c).project(own)[0]).max() for c in found]
    assert max(off) < 0.1
    for camera in shoot.cameras:
        x, y = np.round(found[camera.name]).astype(int).T
        strands = np.zeros((camera.height, camera.width), np.uint8)
        strands[y, x] = 1
        strands, ball = (widened(m) for m in (strands, met(camera)[1]))
        assert ball[y, x].mean() > 0.99
        assert strands[shoot.hair(camera)].mean() > 0.9
    with capsys.disabled():
        lines = "\n".join(f"  {s:6.1f} s  {line}" for line, s in typed.record)
        print(f"\n{name}: off {max(off):.4f} px, errors named {named}\n{lines}")
