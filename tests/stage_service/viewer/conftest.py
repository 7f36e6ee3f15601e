"""A small model on a sphere, and the server of its viewer."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import httpx
import numpy as np
import pytest
from serving import listening_app

from reconstruction import Mesh, Model, Strands
from stage_service.api.app import create_viewer
from stage_service.api.gate import Access
from stage_service.decoding import Decoder
from stage_service.records.tokens import Tokens
from stage_service.viewer import NothingToView, Viewed, Viewing

KEY = "the key"


def bristles(count: int = 400, seed: int = 0) -> Strands:
    """Straight strands of 5 cm that stand on the upper half of a sphere of 8 cm."""
    out = np.random.default_rng(seed).normal(size=(count, 3))
    out[:, 2] = np.abs(out[:, 2])
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    lines = [np.linspace(0.08, 0.13, 6)[:, None] * d for d in out]
    return Strands.from_list(lines, radius=4e-4)


def sphere(radius: float = 0.079, rows: int = 12) -> Mesh:
    """A sphere of triangles."""
    theta, phi = np.meshgrid(
        np.linspace(0, np.pi, rows), np.linspace(0, 2 * np.pi, 2 * rows), indexing="ij"
    )
    around = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    vertices = radius * np.stack(around, axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(2 * rows - 1), indexing="ij")
    a = (i * 2 * rows + j).ravel()
    b, c, d = a + 1, a + 2 * rows, a + 2 * rows + 1
    return Mesh(vertices, np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)]))


@pytest.fixture
def model(bristly: Model) -> Model:
    return bristly


@pytest.fixture
def bristly(tmp_path: Path) -> Model:
    made = Model(tmp_path / "bristles").create()
    made.write_strands(bristles())
    made.write_head(sphere())
    return made


@pytest.fixture
def decoder() -> Iterator[Decoder]:
    with closing(Decoder()) as decoder:
        yield decoder


@pytest.fixture
def viewing(model: Model, decoder: Decoder) -> Viewing:
    def opened(name: str) -> Viewed:
        if name != "bristles":
            raise NothingToView(f"there is no model {name!r}")
        return Viewed(model, truth=bristles(seed=1))

    return Viewing(lambda: ["bristles"], opened, decoder)


@pytest.fixture
def url(viewing: Viewing, tmp_path: Path) -> Iterator[str]:
    with listening_app(create_viewer(viewing, Access(Tokens(tmp_path / "none", KEY)))) as url:
        yield url


@pytest.fixture
def http(url: str) -> Iterator[httpx.Client]:
    headers = {"Authorization": f"Bearer {KEY}"}
    with httpx.Client(base_url=url, headers=headers, timeout=60, trust_env=False) as client:
        yield client
