"""Known fibres on a ball, cameras and lamps about it: exact maps without a renderer."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from reconstruction import Camera, Capture, Light, Rig, Strands, write_exr
from reconstruction.geometry.lights import dome_positions
from reconstruction.light_codes.code_views import View, light_beside, line_vectors
from reconstruction.light_codes.codes import code_map

RADIUS = 0.03
Bools = NDArray[np.bool_]
Array = NDArray[np.float64]


def wisps(count: int, seed: int = 0, length: float = 0.02) -> Strands:
    """Curved fibres on the upper half of a ball of `RADIUS` and up to a twentieth above it."""
    rng = np.random.default_rng(seed)
    strands = []
    for _ in range(count):
        z, a = rng.uniform(0.1, 1), rng.uniform(0, 2 * np.pi)
        n = np.array([np.sqrt(1 - z * z) * np.cos(a), np.sqrt(1 - z * z) * np.sin(a), z])
        d = np.cross(n, rng.normal(size=3))
        d /= np.linalg.norm(d)
        s = np.linspace(0, length / RADIUS, 60)[:, None]
        strands.append(RADIUS * (1 + 0.05 * rng.random()) * (np.cos(s) * n + np.sin(s) * d))
    return Strands.from_list(strands, 2e-4)


@dataclass(frozen=True, eq=False)
class Drawn:
    """What a camera sees: `mask (H, W)`, `angle (H, W)`, `point (H, W, 3)`."""

    mask: Bools
    angle: Array
    point: Array


def draw(camera: Camera, strands: Strands) -> Drawn:
    """Rasterise the fibres with a z-buffer; the ball itself hides what is behind it."""
    dense = strands.resampled(1e-4)
    p, d = dense.points.astype(float), dense.tangents().astype(float)
    xy, z = camera.project(p)
    ahead, _ = camera.project(p + 1e-4 * d)
    turn = np.arctan2(*(ahead - xy).T[::-1]) % np.pi
    front = (p * (camera.center - p)).sum(axis=1) > 0
    wide = float(np.mean(strands.radius)) * camera.K[0, 0] / np.maximum(z, 1e-6)
    shape = (camera.height, camera.width)
    nearest = np.full(shape[0] * shape[1], -1)
    for dy, dx in np.ndindex(5, 5):
        x, y = np.rint(xy[:, 0]).astype(int) + dx - 2, np.rint(xy[:, 1]).astype(int) + dy - 2
        ok = front & (z > 0) & (np.hypot(x - xy[:, 0], y - xy[:, 1]) <= np.maximum(wide, 0.71))
        ok &= (x >= 0) & (y >= 0) & (x < shape[1]) & (y < shape[0])
        order = np.flatnonzero(ok)[np.argsort(-z[ok], kind="stable")]
        flat = y[order] * shape[1] + x[order]
        layer = np.full_like(nearest, -1)
        layer[flat] = order  # the last one written is the nearest
        closer = (layer >= 0) & ((nearest < 0) | (z[layer] < z[nearest]))
        nearest[closer] = layer[closer]
    mask = (nearest >= 0).reshape(shape)
    pick = np.maximum(nearest, 0)
    return Drawn(mask, turn[pick].reshape(shape), p[pick].reshape(*shape, 3))


def lit(points: Array, lights: Sequence[Light]) -> Bools:
    """Which lights reach points `(..., 3)`: the ball's shadow and a pattern of stripes `(..., L)`.

    The stripes, a few millimetres wide, stand for the shadows that strands throw on one another.
    """
    rng = np.random.default_rng(9)
    bits = []
    for light in lights:
        facing = (points * (light.position - points)).sum(axis=-1) > 0
        wave = rng.normal(size=3) * 2 * np.pi / 0.008
        bits.append(facing & (np.sin(points @ wave + rng.uniform(0, 6)) > -0.6))
    return np.stack(bits, axis=-1)


def cameras(count: int = 8, size: int = 72, distance: float = 0.6) -> list[Camera]:
    """Cameras on the upper hemisphere that see the whole ball."""
    places = dome_positions(count, distance, 15.0)
    fov = np.degrees(2 * np.arctan(1.25 * RADIUS / distance))
    return [Camera.look_at(f"c{i}", size, size, p, (0, 0, 0.01), fov) for i, p in enumerate(places)]


def lamps(count: int, beside: Sequence[Camera] = ()) -> list[Light]:
    """Lamps on a dome, the first of them where the cameras `beside` are."""
    places = [c.center for c in beside]
    if count > len(places):
        places += list(dome_positions(count - len(places), 0.7, 0.0))
    return [Light(f"l{i}", p, np.ones(3)) for i, p in enumerate(places[:count])]


@dataclass
class FibreStage:
    """Fibres, cameras and lamps; what the cameras see of them, exactly or as a capture."""

    strands: Strands = field(default_factory=lambda: wisps(60))
    cameras: Sequence[Camera] = field(default_factory=cameras)
    lights: Sequence[Light] = ()

    def __post_init__(self) -> None:
        if not self.lights:
            self.lights = lamps(36, self.cameras)

    @cached_property
    def drawn(self) -> list[Drawn]:
        """What every camera sees."""
        return [draw(c, self.strands) for c in self.cameras]

    @cached_property
    def views(self) -> list[View]:
        """Exact views: true lines, true shadows."""
        out = []
        for camera, observed in zip(self.cameras, self.drawn, strict=True):
            shine = np.moveaxis(lit(observed.point, self.lights), -1, 0).astype(float)
            dark = np.zeros((1, *observed.mask.shape))  # gives the threshold: nothing is lit by it
            codes = code_map(np.concatenate([shine, dark]), observed.mask, len(self.lights))
            lines = line_vectors(observed.angle, observed.mask * 1.0)
            beside = light_beside(camera, self.lights)
            out.append(View(camera, observed.mask, lines, codes, beside))
        return out

    def depth(self, view: int) -> Array:
        """True depths `(H, W)` along the camera's axis."""
        return np.asarray(self.cameras[view].project(self.drawn[view].point)[1])

    def range(self, view: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Depths `(H, W)` between which the ball's near side lies."""
        camera = self.cameras[view]
        near = np.full((camera.height, camera.width), np.linalg.norm(camera.center) - 0.035)
        return near.astype(np.float32), (near + 0.04).astype(np.float32)

    def shoot(
        self, path: Path, *, brightness: float = 1.0, full_scale: float = np.inf, masks: bool = True
    ) -> Capture:
        """A capture: one frame a lamp; a fibre shines along its middle, less where it is shadowed.

        `masks` of the user hold what the fibres cover, a pixel wider.
        """
        (path / "masks").mkdir(parents=True)
        rig = Rig("fibres", tuple(self.cameras), tuple(self.lights))
        (path / "rig.json").write_text(json.dumps(rig.to_dict()))
        steps: list[dict[str, object]] = [{"index": 0, "kind": "dark", "exposure": 0.02}]
        for i, light in enumerate(self.lights):
            steps.append({"index": i + 1, "kind": "olat", "exposure": 0.02, "light": light.name})
        (path / "plan.json").write_text(json.dumps({"steps": steps}))
        lines = []
        rng = np.random.default_rng(4)
        for camera, observed in zip(self.cameras, self.drawn, strict=True):
            tint = 0.6 + 0.4 * np.sin(observed.point @ rng.normal(size=3) * 900)
            shine = np.where(lit(observed.point, self.lights), 1.0, 0.05) * tint[..., None]
            shine = np.where(observed.mask[..., None], brightness * shine, 0)
            for i in range(len(steps)):
                image = np.zeros(observed.mask.shape) if i == 0 else shine[..., i - 1]
                image = image + 1e-4 * rng.standard_normal(image.shape)
                file = f"frames/{i:05d}/{camera.name}.exr"
                (path / file).parent.mkdir(parents=True, exist_ok=True)
                rgb = np.repeat(np.minimum(image, full_scale)[..., None], 3, axis=2)
                attributes = {"fullScale": float(full_scale)} if np.isfinite(full_scale) else {}
                write_exr(path / file, rgb, attributes, compress=False)
                lines.append(json.dumps({"step": i, "camera": camera.name, "file": file}))
            if masks:
                wider = cv2.dilate(observed.mask.astype(np.uint8) * 255, np.ones((3, 3)))
                cv2.imwrite(str(path / "masks" / f"{camera.name}.png"), wider)
        (path / "journal.jsonl").write_text("\n".join(lines) + "\n")
        return Capture(path)


@pytest.fixture(scope="session")
def fibres() -> FibreStage:
    """60 fibres before 8 cameras with a lamp each, and 28 lamps more."""
    return FibreStage()


@pytest.fixture(scope="session")
def make_fibres() -> type[FibreStage]:
    """Makes a stage with other fibres, cameras or lamps."""
    return FibreStage


@pytest.fixture(scope="session")
def fibre_cameras() -> object:
    """Makes cameras about the ball: count, size in pixels, distance."""
    return cameras


@pytest.fixture(scope="session")
def fibre_lamps() -> object:
    """Makes lamps: count, and the cameras that the first of them stand beside."""
    return lamps
