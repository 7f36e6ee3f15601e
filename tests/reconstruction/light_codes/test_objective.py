"""The objective on the device beside the same in numpy, and its directions beside an SVD."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest
from numpy.typing import NDArray

from reconstruction.array_backend import array_types
from reconstruction.light_codes.codes import match
from reconstruction.light_codes.objective import (
    ANGLE_POWER,
    LINE_MATCH_POWER,
    MATCH_POWER,
    OUTLIER_POWER,
    agreement,
    line_through,
    smallest_axis,
)
from reconstruction.light_codes.search import DepthSearch
from reconstruction.reconstruct_options import SearchOptions

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def search(fibres: Any) -> DepthSearch:
    return DepthSearch(fibres.views, (0, 0, 0), SearchOptions())


@pytest.fixture(scope="module")
def some(fibres: Any) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    y, x = np.nonzero(fibres.views[2].mask)
    return y[::37], x[::37]


def looked_up(search: DepthSearch, view: int, k: int, code: Any, points: Array) -> Any:
    """Pixels, lines and shares of equal bits that view `k` has at `points (P, 3)`."""
    own, other = search.views[view], search.views[k]
    xy, z = other.camera.project(points)
    at = np.floor(xy + 0.5).astype(int)
    on = (z > 0) & (at >= 0).all(axis=1)
    on &= (at[:, 0] < other.camera.width) & (at[:, 1] < other.camera.height)
    at[~on] = 0
    line = np.where(on[:, None], other.lines[at[:, 1], at[:, 0]], 0)
    compared = own.codes.varying | other.codes.varying
    equal = match(other.codes.words[at[:, 1], at[:, 0]], code, compared)
    return xy, line, np.where(line.any(axis=1), equal, 0)


def test_the_smallest_axis_is_the_svds() -> None:
    t = array_types()
    rng = np.random.default_rng(1)
    normals = rng.normal(size=(200, 6, 3)) * np.array([1, 0.6, 0.02])
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    normals = normals @ turn
    A = np.einsum("nki,nkj->nij", normals, normals)
    entries = [A[:, 0, 0], A[:, 1, 1], A[:, 2, 2], A[:, 0, 1], A[:, 0, 2], A[:, 1, 2]]
    xx, yy, zz, xy, xz, yz = (t.Float(e.astype(np.float32)) for e in entries)
    line = smallest_axis(t, (xx, yy, zz), (xy, xz, yz))
    _, values, vectors = np.linalg.svd(normals)
    cosine = np.abs((line.direction.numpy().T * vectors[:, 2]).sum(axis=1))
    assert np.degrees(np.arccos(np.minimum(cosine, 1))).max() < 0.1
    np.testing.assert_allclose(line.spread.numpy(), values[:, 1] / values[:, 0], rtol=1e-3)
    np.testing.assert_allclose(line.misfit.numpy(), values[:, 2] / values[:, 1], atol=5e-3)


def test_parallel_planes_have_no_spread() -> None:
    t = array_types()
    zero, one = t.Float(0), t.Float(1)
    line = smallest_axis(t, (one, zero, zero), (zero, zero, zero))
    assert line.spread.numpy()[0] < 1e-3
    nothing = smallest_axis(t, (zero, zero, zero), (zero, zero, zero))
    assert np.isfinite(nothing.direction.numpy()).all()


def test_direction_and_agreement_are_those_of_the_formulas(
    search: DepthSearch, some: Any, fibres: Any
) -> None:
    y, x = some
    view = 2
    t = search.types
    pixels, _ = search.pixels(view, y, x)
    depth = fibres.depth(view)[y, x]
    device_depth = t.Float(depth.astype(np.float32))
    line = line_through(search.device, pixels, pixels.at(device_depth))
    samples, apart = 25, 2e-4
    found = agreement(
        search.device,
        pixels,
        pixels.at(device_depth),
        apart * line.direction,
        dr.opaque(t.UInt32, samples),
    ).numpy()
    own = search.views[view]
    rays = own.camera.rays(np.stack([x, y], axis=1))
    points = own.camera.center + rays * (depth / (rays @ own.camera.R[2]))[:, None]
    code = own.codes.words[y, x]
    sees = np.column_stack([np.ones(len(x), bool), search.visible(view, y, x)])
    order = [view, *search.neighbours[view]]
    direction = np.zeros((len(x), 3))
    for trust in (0, OUTLIER_POWER):
        A = np.zeros((len(x), 3, 3))
        for n, k in enumerate(order):
            xy, own_line, equal = looked_up(search, view, k, code, points)
            M = search.views[k].camera.K @ search.views[k].camera.R
            offset = xy[:, 0] * own_line[:, 1] - xy[:, 1] * own_line[:, 0]
            flat = np.column_stack([-own_line[:, 1], own_line[:, 0], offset])
            normal = flat @ M
            norm = np.linalg.norm(normal, axis=1, keepdims=True)
            normal = np.divide(normal, norm, out=np.zeros_like(normal), where=norm > 0)
            weight = sees[:, n] * equal**LINE_MATCH_POWER
            if trust:
                ahead = search.views[k].camera.project(points + 1e-6 * direction)[0] - xy
                ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
                weight *= np.abs((ahead * own_line).sum(axis=1)) ** trust
            A += weight[:, None, None] * normal[:, :, None] * normal[:, None, :]
        direction = np.linalg.eigh(A)[1][:, :, 0]
    cosine = np.abs((direction * line.direction.numpy().T).sum(axis=1))
    assert np.quantile(np.degrees(np.arccos(np.minimum(cosine, 1))), 0.95) < 0.2

    total = np.zeros(len(x))
    direction = line.direction.numpy().T
    for s in range(samples):
        at = points + (s - (samples - 1) / 2) * apart * direction
        for n, k in enumerate(order):
            xy, own_line, equal = looked_up(search, view, k, code, at)
            ahead = search.views[k].camera.project(at + 1e-6 * direction)[0] - xy
            ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
            cosine = np.abs((ahead * own_line).sum(axis=1))
            total += sees[:, n] * equal**MATCH_POWER * cosine**ANGLE_POWER
    # pixels on the border of two fibres round to either one in single precision
    difference = np.abs(found - total / (samples * sees.sum(axis=1)))
    assert np.quantile(difference, 0.9) < 0.01
    assert difference.max() < 0.1
