"""A tuft seen by a ring of small cameras, with a field planted on it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from appearance import HairAppearance, build_scene, render_olat
from appearance.bsdf.maps import MappedStrands, scalp_coordinates
from appearance.fields.anchors import Grid, Places
from appearance.fields.field import Field
from appearance.fields.form import Form
from appearance.fields.hits import HitOptions, find_hits
from appearance.fields.pictures import Pictures
from appearance.render.coverage import coverage
from appearance.render.harmonics import count_of
from reconstruction import Camera, Light
from reconstruction.geometry.lights import dome_positions

HAIR = HairAppearance((0.06, 0.12, 0.3), 0.25, 0.35)


@pytest.fixture(scope="session")
def planted(small):
    """`views(kind, degree, lights)` with frames of a field on `places` that is known, and `truth`.

    `mapped`, `strands`, `scale`; inverse rendering's pictures are one colour's, of few paths.
    """
    strands = small.tuft(300)
    mapped = MappedStrands.of(
        build_scene(strands, None, hair=HAIR), strands, scalp_coordinates(strands, None)
    )
    places = Places.of(mapped.root_uv)
    angles = np.arange(5) * 2 * np.pi / 5
    cameras = [
        Camera.look_at(f"c{k}", 16, 16, (0.5 * np.cos(a), 0.5 * np.sin(a), 0.1), (0, 0, 0), 12)
        for k, a in enumerate(angles)
    ]
    grid = Grid.of((2, 3, 3), len(strands))
    rendered = {}

    def truth(kind="modulation", degree=1):
        n = count_of(degree)
        c = 0.3 * np.random.default_rng(0).normal(size=(grid.count, n * n * 3))
        if kind != "modulation":
            c *= 0.01
            c[:, :3] = 0.1  # nowhere below black
        return Field.of(Form(kind, degree), grid, places, c.astype(np.float32))

    def views(field, count=16, distance=1.0):
        lights = tuple(
            Light(f"l{i}", p, np.full(3, 5.0 * distance**2))
            for i, p in enumerate(dome_positions(count, distance))
        )
        out = []
        for camera in cameras:
            pixels = np.flatnonzero((coverage(mapped.scene, camera)["hair"] > 0.7).ravel())
            hits = find_hits(mapped, camera, pixels, HitOptions(8))
            key = camera.name, count, distance
            if key not in rendered:
                rendered[key] = render_olat(
                    mapped.scene, camera, lights, spp=16, max_depth=2, pixels=pixels
                )
            shown = rendered[key]
            frames = field.at(hits).lit(shown, lights)
            out.append(
                Pictures(
                    hits, lights, shown[None].repeat(2, 0), frames, np.ones(shown.shape[:2], bool)
                )
            )
        return out

    return SimpleNamespace(
        strands=strands, mapped=mapped, places=places, views=views, truth=truth, scale=20.0
    )
