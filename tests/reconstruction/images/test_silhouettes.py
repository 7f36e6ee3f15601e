"""A lit wall behind the subject, and hair that fills an image."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from reconstruction.arrays import Array
from reconstruction.images.silhouettes import without_lit_background

SIZE = 48
LAMPS = 1.2 * np.stack(  # a dome of 1.2 m about the origin; the camera looks along y
    [
        np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
        for e in np.radians([-10, 15, 40, 65])
        for a in np.radians(np.arange(0, 360, 45.0))
    ]
)
U, V = np.meshgrid(np.linspace(-1, 1, SIZE), np.linspace(-1, 1, SIZE))


def wall(distance: float) -> Array:
    """Radiance `(lamps, H, W)` of a matte wall 0.6 m wide, metres behind the origin."""
    place = np.stack([0.3 * U, np.full_like(U, distance), 0.3 * V], axis=-1)
    to = LAMPS[:, None, None] - place
    return np.asarray(np.maximum(-to[..., 1], 0) / np.linalg.norm(to, axis=-1) ** 3)


def hair(seed: int, lock: int) -> Array:
    """The same of shiny locks `lock` pixels wide, some in shade, on a bow of 60 degrees."""
    rng = np.random.default_rng(seed)
    slant, shade = (
        np.kron(a, np.ones((lock, lock)))[:SIZE, :SIZE] for a in rng.normal(size=(2, SIZE, SIZE))
    )
    turn = np.radians(30 * U)
    normal = np.stack([np.sin(turn), -np.cos(turn), 0 * U], axis=-1)
    side = np.stack([np.cos(turn), np.sin(turn), 0 * U], axis=-1)
    tangent = np.cos(0.5 * slant)[..., None] * (0, 0, 1.0) + np.sin(0.5 * slant)[..., None] * side
    light = LAMPS / np.linalg.norm(LAMPS, axis=1, keepdims=True)
    facing = np.maximum(np.einsum("hwk,lk->lhw", normal, light), 0)
    sine = 1 - np.einsum("hwk,lk->lhw", tangent, light) ** 2
    return np.asarray(np.exp(0.7 * shade) * facing * (0.1 + sine**8))


def kept(frames: Array) -> Array:
    """The silhouette of an image whose pixels are all lit, without its lit background."""
    capture: Any = SimpleNamespace(
        mask=lambda _camera: None,
        of_kind=lambda _kind: [
            SimpleNamespace(n=k, exposure=1.0, level=1.0) for k in range(len(frames))
        ],
        has=lambda *_: True,
        dark_steps=lambda *_: [],
        rig=SimpleNamespace(camera=lambda _name: SimpleNamespace(height=SIZE, width=SIZE)),
        response_and_saturated=lambda step, _camera: (
            np.repeat(frames[step.n, ..., None], 3, axis=2).astype(np.float32),
            np.zeros((SIZE, SIZE), bool),
        ),
    )
    return without_lit_background(capture, "left", np.ones((SIZE, SIZE), bool))


@pytest.mark.parametrize("noise", [0.0, 0.5])
@pytest.mark.parametrize("distance", [0.5, 2.0, 4.0])
def test_a_wall_is_removed_near_and_far_and_under_noise(distance: float, noise: float) -> None:
    """Noise in shares of the wall's median radiance."""
    disc = U**2 + V**2 < 0.25
    level = float(np.median(wall(distance)))
    frames = np.where(disc, 60 * level * hair(0, 1), wall(distance))
    frames += noise * level * np.random.default_rng(1).normal(size=frames.shape)
    found = kept(frames)
    assert found[~disc].mean() < 0.05
    assert found[disc].mean() > 0.95


@pytest.mark.parametrize("lock", [1, 3, 6])
@pytest.mark.parametrize("seed", range(3))
def test_hair_that_fills_an_image_is_no_background(seed: int, lock: int) -> None:
    assert kept(hair(seed, lock)).all()
