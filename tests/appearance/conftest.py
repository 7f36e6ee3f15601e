"""Subjects that a renderer's tests can afford."""

from __future__ import annotations

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from reconstruction import Camera, Light, Mesh, Strands


def plane(half: float = 0.5) -> Mesh:
    """The square |x|, |y| <= half at z = 0."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * half
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def ball(axes: tuple[float, float, float] = (0.08, 0.08, 0.08), rows: int = 48) -> Mesh:
    """An ellipsoid about the origin with outward faces."""
    theta, phi = np.meshgrid(
        np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, 2 * rows + 1), indexing="ij"
    )
    v = np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1
    ).reshape(-1, 3)
    i = np.arange(rows)[:, None] * (2 * rows + 1) + np.arange(2 * rows)
    below = i + 2 * rows + 1
    faces = [np.stack([i, below, i + 1], -1), np.stack([i + 1, below, below + 1], -1)]
    return Mesh(v * np.array(axes), np.concatenate([f.reshape(-1, 3) for f in faces]))


def tuft(strands: int = 400, seed: int = 0) -> Strands:
    """Slightly curved strands of 6 cm that stand up from a disc of 2 cm."""
    rng = np.random.default_rng(seed)
    angle, r = rng.uniform(0, 2 * np.pi, strands), 0.02 * np.sqrt(rng.uniform(size=strands))
    root = np.stack([r * np.cos(angle), r * np.sin(angle), np.full(strands, -0.03)], -1)
    t = np.linspace(0, 1, 8)[:, None]
    bend = rng.normal(scale=0.008, size=(strands, 1, 3)) * t**2
    points = root[:, None] + bend + 0.06 * t * np.array([0, 0, 1.0])
    return Strands(
        points.reshape(-1, 3).astype(np.float32), 8 * np.arange(strands + 1), radius=4e-4
    )


def camera(position: tuple[float, float, float] = (0.0, -0.5, 0.1), size: int = 24) -> Camera:
    """A small camera that looks at the origin."""
    return Camera.look_at("cam", size, size, position, (0, 0, 0), fov_deg=10)


def lights() -> list[Light]:
    """In front, behind, above; of different colours."""
    return [
        Light("front", np.array([0.3, -0.9, 0.3]), np.array([8.0, 8.0, 8.0])),
        Light("behind", np.array([0.2, 1.0, 0.2]), np.array([4.0, 8.0, 2.0])),
        Light("above", np.array([-0.2, 0.1, 1.0]), np.array([8.0, 4.0, 8.0])),
    ]


@pytest.fixture(scope="session")
def mitsubas_shadows() -> None:
    """Skips where Mitsuba's own shadow rays are wrong: see `HairScene.occluded`."""
    if str(mi.variant()).startswith("cuda"):
        pytest.skip("on a GPU, Mitsuba's path integrator stops light that comes through a fibre")


@pytest.fixture(scope="session")
def small() -> SimpleNamespace:
    """`plane`, `ball`, `tuft`, `camera` and `lights` above, and `no_hair`."""
    return SimpleNamespace(
        plane=plane,
        ball=ball,
        tuft=tuft,
        camera=camera,
        lights=lights,
        no_hair=Strands.from_list([]),
    )
