"""Single lights of a sphere that moves, against the same sphere kept still."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from reconstruction import Camera, Capture, CaptureError, CaptureWriter, Light, Rig, Step, verify
from reconstruction.geometry.lights import dome_positions
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.light_planes import Motion, stabilising
from reconstruction.light_planes.stabilising import stabilise
from reconstruction.light_planes.warp import Warp
from stage_service.cli import main

Pose = tuple[np.ndarray, np.ndarray]
STILL: Pose = (np.eye(3), np.zeros(3))
EVERY, LIGHTS = 3, 9
RADIUS = 0.1


def moved(share: float) -> Pose:
    """A pose on the way to 6 mm and 2°."""
    turn = Rotation.from_rotvec(np.radians(2.0) * share * np.array([0.3, 0.2, 0.93])).as_matrix()
    return turn, 6e-3 * share * np.array([0.6, -0.5, 0.62])


def albedo(points: np.ndarray) -> np.ndarray:
    """An albedo `(...)` without a period, of detail of about 2 cm, four pixels."""
    rng, out = np.random.default_rng(1), np.full(points.shape[:-1], 0.6)
    for _ in range(6):
        a = rng.normal(size=3)
        a *= 2 * np.pi / 2e-2 / np.linalg.norm(a)
        out += 0.09 * np.sin(points @ a * rng.uniform(0.6, 1.4) + rng.uniform(0, 6))
    return out


@dataclass(frozen=True)
class MovingSphere:
    """A lit frame before every third light and after the last; `kind` is that of lit frames."""

    look: Callable[..., tuple[np.ndarray, np.ndarray]]
    cameras: Sequence[Camera]
    kind: str = "tracking"
    level: Callable[[Step], float] = lambda step: 1.0
    full_scale: float = np.inf
    missing: Callable[[Step, str], bool] = lambda step, camera: False

    @property
    def rig(self) -> Rig:
        places = dome_positions(LIGHTS, 1.0, -20)
        lights = [Light(f"light_{k}", p, np.ones(3)) for k, p in enumerate(places)]
        return Rig("sphere", tuple(self.cameras), tuple(lights))

    def steps(self) -> list[Step]:
        kinds: list[dict[str, str]] = []
        for k in range(LIGHTS):
            kinds += [{"kind": self.kind}] * (k % EVERY == 0)
            kinds.append({"kind": "olat", "light": f"light_{k}"})
        return [Step(i, exposure=0.02, **k) for i, k in enumerate([*kinds, {"kind": self.kind}])]

    def image(self, camera: Camera, step: Step, pose: Pose) -> np.ndarray:
        """The subject in its own frame, so that camera and light move the other way."""
        points, hit = self.look(camera.moved(*pose), 2)
        shade = albedo(points)
        if step.light is not None:
            to = self.rig.light(step.light).moved(*pose).position - points
            shade = shade * np.maximum((to * points).sum(axis=-1), 0) / RADIUS
        grey = self.level(step) * (shade * hit).mean(axis=-1)
        return np.repeat(np.minimum(grey, self.full_scale)[..., None], 3, axis=2)

    def shoot(self, path: Path, poses: Callable[[Step], Pose]) -> Capture:
        writer = CaptureWriter.create(path, self.rig, {"steps": self.steps()})
        records = []
        for step in self.steps():
            for camera in self.cameras:
                if self.missing(step, camera.name):
                    writer.record_missing(step, camera.name, reason="dropped")
                    continue
                image = self.image(camera, step, poses(step))
                records.append(
                    writer.store_frame(step, camera.name, image, full_scale=self.full_scale)
                )
        writer.commit(records)
        writer.finish("completed")
        return Capture(path)


def drift(step: Step) -> Pose:
    return moved(step.index / 12)


@pytest.fixture(autouse=True)
def _coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Voxels of two pixels."""
    monkeypatch.setattr(stabilising, "VOXEL", 8e-3)


@pytest.fixture(scope="module")
def sphere(
    look_at_sphere: Callable[..., tuple[np.ndarray, np.ndarray]],
    stage_camera: Callable[..., Camera],
) -> MovingSphere:
    angles = [(-60, 5), (0, 35), (60, 0), (180, 10)]
    cameras = [stage_camera(f"c{k}", a, e, size=48) for k, (a, e) in enumerate(angles)]
    return MovingSphere(look_at_sphere, cameras)


@pytest.fixture(scope="module")
def moving(sphere: MovingSphere, tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return sphere.shoot(tmp_path_factory.mktemp("moving") / "c", drift)


def off(stage: MovingSphere, capture: Capture) -> float:
    """Relative error of the single lights beside those of the still subject, off its outline."""
    error = size = 0.0
    for camera in stage.cameras:
        inside = ndimage.binary_erosion(stage.look(camera, 1)[1][..., 0], iterations=3)
        for step in (s for s in stage.steps() if s.light is not None):
            true = stage.image(camera, step, STILL)[inside]
            error += float(np.square(capture.frame(step, camera.name)[inside] - true).sum())
            size += float(np.square(true).sum())
    return (error / size) ** 0.5


def worst(motion: Motion, poses: Callable[[Step], Pose], steps: Sequence[Step]) -> float:
    """Largest error of a single light's pose at the sphere's poles, metres."""
    poles = RADIUS * np.concatenate([np.eye(3), -np.eye(3)])
    errors = []
    for step in (s for s in steps if s.light is not None):
        (turn,), (shift,) = motion.at(step.index)
        R, t = poses(step)
        errors.append(np.linalg.norm(poles @ (turn - R).T + shift - t, axis=1).max())
    return float(max(errors))


def test_a_drift_is_taken_off(sphere: MovingSphere, moving: Capture, tmp_path: Path) -> None:
    """A pixel is 4.9 mm on the sphere."""
    found = stabilise(moving, tmp_path / "s")
    assert found.capture.path == tmp_path / "s"
    assert verify(tmp_path / "s") == []
    assert worst(found.motion, drift, sphere.steps()) < 0.5e-3
    assert found.figures["largest_mm"] == pytest.approx(6.64, abs=0.5)
    assert found.figures["error_mm"] < 0.6
    before, after = (found.figures[f"lit_difference_{k}"] for k in ("as_shot", "stabilised"))
    assert after < 0.35 * before
    assert off(sphere, found.capture) < 0.35 * off(sphere, moving)
    # lights are where the subject, in its first pose, had them
    light = moving.rig.light("light_8")
    true = light.moved(*drift(sphere.steps()[-2])).position
    assert found.capture.rig.light("light_8").position == pytest.approx(true, abs=6e-3)
    assert np.linalg.norm(light.position - true) > 20e-3
    with pytest.raises(CaptureError, match="corrected already"):
        stabilise(found.capture, tmp_path / "t")


@pytest.mark.slow
def test_a_jump_is_placed_between_two_single_lights(
    sphere: MovingSphere, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def jump(step: Step) -> Pose:
        return moved(2.5 * float(step.index >= 6))  # lit frames are 4 and 8

    sphere.shoot(tmp_path / "c", jump)
    assert main(["stabilise", str(tmp_path / "c"), "--out", str(tmp_path / "s")]) == 0
    said = capsys.readouterr()
    assert "between the lit frames of steps 4 and 8: before step 6" in said.err
    assert "4 lit frames show motion of up to" in said.out
    assert off(sphere, Capture(tmp_path / "s")) < 0.35 * off(sphere, Capture(tmp_path / "c"))


@pytest.mark.slow
def test_lit_frames_that_cannot_be_used(sphere: MovingSphere, tmp_path: Path) -> None:
    """One dark, one saturated, and one frame that two of four cameras lost."""
    stage = replace(
        sphere,
        kind="all_on",
        level=lambda s: {4: 0.1, 8: 30.0}.get(s.index, 1.0),
        full_scale=1.2,
        missing=lambda s, c: s.index == 12 and c in ("c0", "c3"),
    )
    found = stabilise(stage.shoot(tmp_path / "c", drift), tmp_path / "s")
    assert [w for w in found.warnings if "dark" in w and w.endswith("steps 4")]
    assert [w for w in found.warnings if "saturated" in w and w.endswith("steps 8")]
    assert found.motion.steps.tolist() == [0, 12]
    assert worst(found.motion, drift, stage.steps()) < 1e-3


@pytest.mark.slow
def test_frames_beside_a_lost_lit_frame_are_missing(sphere: MovingSphere, tmp_path: Path) -> None:
    def gone(step: Step) -> Pose:
        return (moved(45.0)[0], np.zeros(3)) if step.index == 8 else drift(step)

    found = stabilise(sphere.shoot(tmp_path / "c", gone), tmp_path / "s")
    lost = [s.index for s in found.capture.steps if not found.capture.has(s, "c0")]
    assert lost == [5, 6, 7, 8, 9, 10, 11]
    assert any("could not be aligned" in w for w in found.warnings)


@pytest.mark.parametrize(
    ("lit", "said"),
    [
        ([], "0 usable fully lit frames"),
        ([0], "1 usable fully lit frames"),
        ([0, 4, 8, 12], "4 lit frames show no motion: at most"),
    ],
)
def test_nothing_is_written_without_motion(
    lit: list[int], said: str, sphere: MovingSphere, tmp_path: Path
) -> None:
    source = sphere.shoot(tmp_path / "c", lambda step: STILL)
    source.steps = tuple(s for s in source.steps if s.light is not None or s.index in lit)
    found = stabilise(source, tmp_path / "s")
    assert said in found.summary
    assert found.capture is source
    assert not (tmp_path / "s").exists()


def test_a_motion_that_nothing_shows_is_not_called_still(
    moving: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stabilising, "OUTLINE", 1.0)  # no point is left inside the masks
    found = stabilise(moving, tmp_path / "s")
    assert "its motion is unknown" in found.summary
    assert found.capture is moving
    assert found.figures == {}


def test_frames_that_come_no_closer_remain_as_they_are(
    moving: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    maps = Warp.maps
    monkeypatch.setattr(Warp, "maps", lambda self, turn, shift: maps(self, turn.T, -shift))
    found = stabilise(moving, tmp_path / "s")
    assert "lit frames differ from the first by" in found.summary
    assert found.capture is moving
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize("by", [1, 3])
def test_a_warp_is_the_motion_in_the_image_through_a_lens(
    by: int, sphere: MovingSphere, stage_camera: Callable[..., Camera]
) -> None:
    """Within a tenth of a pixel on the sphere, whose voxels are 2 mm wide."""
    camera = replace(stage_camera("bent", 20.0, size=100), distortion=np.array([-0.3, 0.5]))
    index = np.stack(np.meshgrid(*[np.arange(-60, 61)] * 3, indexing="ij"), axis=-1)
    ball = VoxelGrid(np.full(3, -0.12), 2e-3, np.linalg.norm(2e-3 * index, axis=-1) < RADIUS)
    pose = moved(1.0)
    x, y = Warp.of(camera, ball, by).maps(*pose)
    points, hit = sphere.look(camera, 1)
    inside = ndimage.binary_erosion(hit[..., 0], iterations=6)
    true, _ = camera.project(points[..., 0, :][inside] @ pose[0].T + pose[1])
    assert np.abs(np.stack([x, y], axis=-1)[inside] - true).max() < 0.15
    still = np.stack(np.meshgrid(np.arange(100), np.arange(100)), axis=-1)[inside]
    assert np.linalg.norm(true - still, axis=1).min() > 1.0
