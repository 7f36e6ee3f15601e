"""A stage small enough for unit tests: a textured sphere, ray-cast exactly, shot into a capture."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from reconstruction import Camera, Capture, Light, Projector, Rig, write_exr
from reconstruction.light_planes import PointCloud

RADIUS = 0.1
SIZE, ROWS = 64, 40
Pose = tuple[NDArray[np.float64], NDArray[np.float64]]
STILL: Pose = (np.eye(3), np.zeros(3))


def camera(name: str, azimuth_deg: float, elevation_deg: float = 10.0, size: int = SIZE) -> Camera:
    """A camera 0.9 m from the origin that sees the whole sphere; azimuth 0 looks along +y."""
    a, e = np.radians([azimuth_deg, elevation_deg])
    position = 0.9 * np.array([np.cos(e) * np.sin(a), -np.cos(e) * np.cos(a), np.sin(e)])
    return Camera.look_at(name, size, size, position, (0, 0, 0), 15.0)


def projector(name: str = "proj", azimuth_deg: float = 0.0, roll_deg: float = 90.0) -> Projector:
    """A projector 1 m from the origin whose rows stand upright."""
    a = np.radians(azimuth_deg)
    position = (np.sin(a), -np.cos(a), 0.2)
    return Projector.look_at(name, ROWS, ROWS, position, (0, 0, 0), 14.0, roll_deg=roll_deg)


def texture(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """A smooth albedo `(...)` in [0.2, 1] that moves with the subject."""
    x, y, z = np.moveaxis(points * (2 * np.pi / 0.05), -1, 0)
    return 0.6 + 0.2 * (np.sin(x + 0.7 * y) * np.cos(0.9 * z) + np.sin(0.8 * z - 0.6 * x + y))


def look(device: Camera, samples: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Points `(H, W, S, 3)` where a pixel's rays meet the sphere, and which do `(H, W, S)`."""
    sub = (np.arange(samples) + 0.5) / samples - 0.5
    offsets = np.stack(np.meshgrid(sub, sub), axis=-1).reshape(-1, 2)
    grid = np.stack(np.meshgrid(np.arange(device.width), np.arange(device.height)), axis=-1)
    rays = device.rays(grid[:, :, None] + offsets)
    b = rays @ device.center
    inside = b**2 - (device.center @ device.center - RADIUS**2)
    distance = -b - np.sqrt(np.maximum(inside, 0))
    return device.center + distance[..., None] * rays, (inside > 0) & (distance > 0)


@dataclass
class SphereStage:
    """What to shoot; `shoot` writes the capture folder."""

    cameras: Sequence[Camera]
    projectors: Sequence[Projector] = field(default_factory=lambda: [projector()])
    lights: Sequence[Light] = ()
    poses: Sequence[Pose] = (STILL,)  # one for each tracking interval
    every: int = 10
    noise: float = 0.0
    full_scale: float = np.inf
    brightness: float = 1.0
    missing: Sequence[tuple[int, str]] = ()  # (row of the first projector, camera)
    sweep: bool = True
    samples: int = 3
    albedo: Callable[[NDArray[np.float64]], NDArray[np.float64]] = texture
    extra: Callable[[dict[str, object], Camera], NDArray[np.float64]] | None = None

    def shoot(self, path: Path) -> Capture:
        """Write rig, plan, journal and frames under `path`, and open them."""
        rng = np.random.default_rng(3)
        rig = Rig("sphere", tuple(self.cameras), tuple(self.lights), tuple(self.projectors))
        path.mkdir(parents=True)
        (path / "rig.json").write_text(json.dumps(rig.to_dict()))
        steps, poses = self._steps()
        (path / "plan.json").write_text(json.dumps({"steps": steps}))
        lines = []
        for device in self.cameras:
            cache: dict[int, dict[str, NDArray[np.float64]]] = {}
            for step, interval in zip(steps, poses, strict=True):
                row, kind = step.get("row"), step["kind"]
                if (row, device.name) in self.missing and step["projector"] == rig.projectors[
                    0
                ].name:
                    record = {"file": None, "reason": "dropped"}
                else:
                    if interval not in cache:
                        cache[interval] = self._sweep(device, self.poses[interval])
                    image = self._image(step, device, cache[interval])
                    image = image + self.noise * rng.standard_normal(image.shape)
                    file = f"frames/{step['index']:05d}/{device.name}.exr"
                    (path / file).parent.mkdir(parents=True, exist_ok=True)
                    limit = self.full_scale if kind == "scanline" else np.inf
                    rgb = np.repeat(np.minimum(image, limit)[..., None], 3, axis=2)
                    attributes = {"fullScale": float(limit)} if np.isfinite(limit) else {}
                    write_exr(path / file, rgb, attributes, compress=False)
                    record = {"file": file}
                lines.append(json.dumps({"step": step["index"], "camera": device.name, **record}))
        (path / "journal.jsonl").write_text("\n".join(lines) + "\n")
        return Capture(path)

    def _steps(self) -> tuple[list[dict[str, object]], list[int]]:
        steps: list[dict[str, object]] = []
        poses: list[int] = []

        def add(pose: int, **what: object) -> None:
            steps.append({"index": len(steps), "exposure": 0.02, **what})
            poses.append(pose)

        add(0, kind="dark")
        add(0, kind="all_on")
        for light in self.lights:
            add(0, kind="olat", light=light.name)
        count = 0
        for device in self.projectors if self.sweep else ():
            for row in range(device.height):
                pose = min(count // self.every, len(self.poses) - 1)
                if count % self.every == 0:
                    add(pose, kind="tracking")
                add(pose, kind="scanline", projector=device.name, row=row)
                count += 1
        return steps, poses

    def _sweep(self, device: Camera, pose: Pose) -> dict[str, NDArray[np.float64]]:
        """Frames `(rows, H, W)` of every projector on the subject in `pose`, and the silhouette."""
        points, hit = look(device.moved(*pose), self.samples)
        frames = {"hit": hit.mean(axis=-1)}
        for lamp in self.projectors:
            beam = lamp.moved(*pose)
            pixels, _ = beam.project(points)
            to = beam.center - points
            cosine = (to * points).sum(axis=-1) / (np.linalg.norm(to, axis=-1) * RADIUS)
            shade = np.maximum(cosine, 0) * self.albedo(points)
            light = np.where(hit & beam.inside(pixels), shade, 0)
            rows = np.arange(lamp.height)[:, None, None, None]
            frames[lamp.name] = (beam.row_weight(rows, pixels[..., 1]) * light).mean(axis=-1)
        return frames

    def _image(
        self, step: dict[str, object], device: Camera, frames: dict[str, NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        shape = frames["hit"].shape
        if step["kind"] == "all_on":
            return np.asarray(frames["hit"] * 1.0)
        if step["kind"] == "scanline":
            return np.asarray(self.brightness * frames[str(step["projector"])][step["row"]])
        if step["kind"] == "tracking":
            beams = [frames[p.name].sum(axis=0) for p in self.projectors]
            return np.asarray(self.brightness * sum(beams, np.zeros(shape)))
        if step["kind"] == "olat" and self.extra is not None:
            return self.extra(step, device)
        return np.zeros(shape)


@pytest.fixture(scope="session")
def two_cameras() -> SphereStage:
    """A still sphere, two cameras to the left and right of one projector."""
    return SphereStage([camera("left", -40), camera("right", 35)])


@pytest.fixture(scope="session")
def sphere_capture(tmp_path_factory: pytest.TempPathFactory, two_cameras: SphereStage) -> Capture:
    """The still sphere, shot without noise."""
    return two_cameras.shoot(tmp_path_factory.mktemp("sphere") / "capture")


@pytest.fixture(scope="session")
def shoot(
    tmp_path_factory: pytest.TempPathFactory, two_cameras: SphereStage
) -> Callable[..., Capture]:
    """Shoot the two-camera stage with some fields changed."""

    def make(**changes: object) -> Capture:
        stage = replace(two_cameras, **changes)  # type: ignore[arg-type]
        return stage.shoot(tmp_path_factory.mktemp("sphere") / "capture")

    return make


@pytest.fixture(scope="session")
def stage_camera() -> Callable[..., Camera]:
    """Makes a camera of the sphere's stage: name, azimuth and elevation in degrees."""
    return camera


@pytest.fixture(scope="session")
def cloud_of() -> Callable[..., PointCloud]:
    """Makes a cloud of points `(N, 3)`, the number of each one's camera `(N,)`, and their names."""

    def make(points: NDArray[np.float64], of: NDArray[np.int64], names: list[str]) -> PointCloud:
        n, zero, one = len(points), np.zeros(len(points)), np.ones(len(points), np.float32)
        covariance, view = np.tile(1e-8 * np.eye(3), (n, 1, 1)), np.tile([0, 0, 1.0], (n, 1))
        rest = zero.astype(np.int16), 0 * one, zero.astype(np.int32), one, one
        pixel, camera = np.zeros((n, 2), np.int32), of.astype(np.int16)
        return PointCloud(points, covariance, view, pixel, camera, *rest, tuple(names), ("p",))

    return make


@pytest.fixture(scope="session")
def stage_projector() -> Callable[..., Projector]:
    """Makes a projector of the sphere's stage: name, azimuth and roll in degrees."""
    return projector


@pytest.fixture(scope="session")
def look_at_sphere() -> Callable[..., tuple[NDArray[np.float64], NDArray[np.bool_]]]:
    """Casts a camera's rays at the sphere."""
    return look
