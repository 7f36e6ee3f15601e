"""A tuft of known hair seen by two small cameras under eight lights."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from appearance import HairAppearance, build_scene, render_olat
from appearance.bsdf.maps import HairMaps, MappedStrands, scalp_coordinates
from appearance.inverse_rendering.options import Effort
from appearance.inverse_rendering.problem import FitProblem
from appearance.observations import Observed
from appearance.render.coverage import coverage
from reconstruction import Camera, Light

TRUTH = HairAppearance((0.06, 0.12, 0.3), 0.25, 0.35)
SKIN = np.full(3, 0.3)
DEPTH = 6
QUICK = Effort(pixels=100, spp=16, max_depth=DEPTH)


def dome(count: int, distance: float = 1.0) -> tuple[Light, ...]:
    d = np.random.default_rng(0).normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    watts = np.full(3, 5.0 * distance**2)
    return tuple(Light(f"l{i}", x * distance, watts) for i, x in enumerate(d))


def cameras(count: int) -> list[Camera]:
    places = [(0, -0.5, 0.1), (0.45, 0.2, 0.1)][:count]
    return [Camera.look_at(f"c{i}", 20, 20, p, (0, 0, 0.0), 12) for i, p in enumerate(places)]


def observed(scene, camera, lights, spp=128, depth=DEPTH):
    pixels = np.flatnonzero((coverage(scene, camera)["hair"] > 0.5).ravel())
    radiance = render_olat(scene, camera, lights, spp=spp, max_depth=depth, pixels=pixels, seed=99)
    return Observed(camera, lights, pixels, radiance, np.ones(radiance.shape[:2], bool))


def exposure(views) -> float:
    return 1 / float(np.percentile(np.concatenate([o.radiance.ravel() for o in views]), 99))


@pytest.fixture(scope="session")
def tufted(small):
    """`mapped` strands, and `problem(truth=…, views=…, lights=…, spp=…)` with frames of that truth.

    `quick` is what a test can afford a step, `truth` the hair of `plain`.
    """
    strands = small.tuft(300)
    scene = build_scene(strands, None, hair=TRUTH)
    mapped = MappedStrands.of(scene, strands, scalp_coordinates(strands, None))

    def problem(truth=None, views=2, lights=None, spp=128):
        maps = HairMaps.of(TRUTH) if truth is None else truth
        lights = dome(8) if lights is None else lights
        shown = mapped.with_maps(maps)
        observed_views = [observed(shown, c, lights, spp) for c in cameras(views)]
        return FitProblem(mapped, observed_views, exposure(observed_views), SKIN)

    return SimpleNamespace(
        mapped=mapped,
        strands=strands,
        scene=scene,
        problem=problem,
        quick=QUICK,
        truth=TRUTH,
        dome=dome,
    )


@pytest.fixture(scope="session")
def observing():
    """`observing(mapped, shown, cameras, lights, spp=…, depth=…)`: a problem of hair `shown`."""

    def problem(mapped, shown, around, lights, **how):
        views = [observed(shown, c, tuple(lights), **how) for c in around]
        return FitProblem(mapped, views, exposure(views), SKIN)

    return problem


@pytest.fixture(scope="session")
def plain(tufted):
    """The problem of one colour."""
    return tufted.problem()
