"""The shape of a face by photometric stereo under single lights (Woodham 1980).

Skin is nearly matte: radiance under lights at known positions gives normals, and these the depth
up to scale. The visual hull fixes the scale: skin lies behind its surface and touches it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve

from reconstruction.arrays import AnyFloats, Array, Bools
from reconstruction.capture.folder import Capture
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.images.grey import grey
from reconstruction.images.visual_hull import first_depth, surface_points

FEWEST_LIGHTS, MOST_LIGHTS = 24, 110
"""Least number of lights for a normal, and about the most that are read."""
FEWEST_PIXELS = 300

_ROUNDS = 4  # of normals and depths: light directions depend on depth
_SHADED, _SHINING = 0.5, 1.5  # of the matte radiance: lights outside this range are skipped
_GRAZING = 0.3  # least cosine to the ray of an integrated pixel
_BENT = 0.85  # least cosine between neighbouring normals; below, there may be an edge
_TOUCHING = 0.97  # share of the skin on or behind the hull's surface


@dataclass(frozen=True, eq=False)
class LitSkin:
    """Skin points `(N, 3)` visible in a `camera`, and outward unit `normals (N, 3)`."""

    points: Array
    normals: Array
    camera: str


def lit_skin(
    capture: Capture, camera: Camera, skin: Bools, hull: VoxelGrid, lowest: float = -np.inf
) -> LitSkin | None:
    """The largest connected part of `skin (H, W)` of a camera, above the height `lowest`, metres.

    Pixels are averaged to the size of the voxels of the subject's `hull`. None with fewer than
    `FEWEST_LIGHTS` lights that reach the head or `FEWEST_PIXELS` connected pixels. On rendered
    faces the shape is accurate to 1 to 2 mm, the position to 3 mm.
    """
    names = [n for n in capture.olat_lights() if capture.has_light(n, camera.name)]
    names = [n for n in names if capture.rig.light(n).intensity_towards(np.zeros(3)).any()]
    if len(names) < FEWEST_LIGHTS:
        return None
    names = names[:: -(-len(names) // MOST_LIGHTS)]
    away = float(camera.project(hull.centers().mean(axis=0)[None])[1][0])
    by = max(1, round(hull.spacing * camera.K[0, 0] / away))
    whole, camera = camera, camera.reduced(by)
    skin = _blocks(skin, by).min(axis=(1, 3))
    first = first_depth(camera, hull)
    heights = surface_points(camera, np.where(np.isfinite(first), first, 0))[..., 2]
    skin = _largest(skin & np.isfinite(first) & (heights > lowest))
    if skin.sum() < FEWEST_PIXELS:
        return None
    lights = [capture.rig.light(n) for n in names]
    values, known = np.zeros((2, int(skin.sum()), len(names)))
    for k, (name, light) in enumerate(zip(names, lights, strict=True)):
        image, saturated = capture.light(name, whole.name)
        strength = float(light.intensity_towards(np.zeros(3)).mean())
        values[:, k] = _blocks(grey(image), by).mean(axis=(1, 3))[skin] / strength
        known[:, k] = ~_blocks(saturated, by).max(axis=(1, 3))[skin]
    places = np.stack([light.position for light in lights])
    depth = surface = first[skin]
    for _ in range(_ROUNDS):
        points = surface_points(camera, _image(skin, depth))[skin]
        normals = matte_normals(values, places - points[:, None], known > 0)
        log_depth, piece = integrated(camera, skin, normals)
        nearest = np.bincount(piece).argmax() == piece
        scale = np.quantile((np.log(surface) - log_depth)[nearest], _TOUCHING)
        depth = np.where(nearest, np.exp(log_depth + scale), surface)
    if nearest.sum() < FEWEST_PIXELS:
        return None
    points = surface_points(camera, _image(skin, depth))[skin]
    return LitSkin(points[nearest], normals[nearest], whole.name)


def matte_normals(values: AnyFloats, to_light: Array, known: Bools | None = None) -> Array:
    """Unit normals `(N, 3)` of matte pixels with `values (N, L)` under L lights.

    `to_light (N, L, 3)` is the vector from each pixel to each light, metres; irradiance falls with
    its square. Excluded are values not `known (N, L)`, and values outside `_SHADED` to `_SHINING`
    of the matte radiance. 0 if no light remains.
    """
    square = (to_light**2).sum(axis=2)
    ahead = to_light / np.sqrt(square)[..., None]
    v = np.asarray(values) * square
    whole = np.ones(v.shape, bool) if known is None else known
    lit = whole & (v > 0.25 * np.quantile(v, 0.95, axis=1, keepdims=True))
    for _ in range(6):
        moments = np.einsum("nl,nli,nlj->nij", lit, ahead, ahead) + 1e-2 * np.eye(3)
        g = np.linalg.solve(moments, np.einsum("nl,nli->ni", lit * v, ahead)[..., None])[..., 0]
        matte = np.maximum(np.einsum("ni,nli->nl", g, ahead), 0)
        lit = whole & (v > _SHADED * matte) & (v < _SHINING * matte)
        lit &= matte > 0.05 * matte.max(axis=1, keepdims=True)
    return np.asarray(g / np.maximum(np.linalg.norm(g, axis=1, keepdims=True), 1e-12))


def integrated(camera: Camera, region: Bools, normals: Array) -> tuple[Array, Array]:
    """Log depths `(N,)` of the pixels of `region (H, W)`, up to a constant per part.

    Least-squares integration of world `normals (N, 3)`. Also the index of the part `(N,)`: parts
    are separated at grazing angles and sharp bends, where there may be an edge.
    """
    y, x = np.nonzero(region)
    number = np.full(region.shape, -1)
    number[y, x] = np.arange(len(y))
    n = normals @ camera.R.T
    rays = camera.rays(np.stack([x, y], axis=1)) @ camera.R.T
    rays /= rays[:, 2:]
    facing = -(n * rays).sum(axis=1)
    gradient = n[:, :2] @ np.linalg.inv(camera.K[:2, :2]) / np.maximum(facing, 0.1)[:, None]
    follows = facing > _GRAZING
    rows, columns, entries, wanted = [], [], [], []
    count = 0
    for axis, (dy, dx) in enumerate(((0, 1), (1, 0))):
        a = np.flatnonzero((y + dy < region.shape[0]) & (x + dx < region.shape[1]))
        b = number[y[a] + dy, x[a] + dx]
        a, b = a[b >= 0], b[b >= 0]
        keep = follows[a] & follows[b] & ((n[a] * n[b]).sum(axis=1) > _BENT)
        a, b = a[keep], b[keep]
        weight = np.minimum(facing[a], facing[b])
        row = count + np.arange(len(a))
        count += len(a)
        rows += [row, row]
        columns += [a, b]
        entries += [-weight, weight]
        wanted.append(weight * 0.5 * (gradient[a, axis] + gradient[b, axis]))
    where = np.concatenate(rows), np.concatenate(columns)
    system = sparse.csr_array((np.concatenate(entries), where), shape=(count, len(y)))
    normal = (system.T @ system + 1e-9 * sparse.eye_array(len(y))).tocsc()
    log_depth = np.asarray(spsolve(normal, system.T @ np.concatenate(wanted)))
    return log_depth, np.asarray(connected_components(normal, directed=False)[1])


def _image(region: Bools, values: Array) -> Array:
    """`values (N,)` of the pixels of `region (H, W)` as an image, 1 outside."""
    out = np.ones(region.shape)
    out[region] = values
    return out


def _blocks(image: AnyFloats | Bools, by: int) -> Array:
    """An image `(H, W)` in blocks `(h, by, w, by)`, cropped to full blocks."""
    height, width = (n // by for n in image.shape)
    return np.asarray(image[: height * by, : width * by].reshape(height, by, width, by))


def _largest(mask: Bools) -> Bools:
    """The largest connected part of a mask."""
    label, count = ndimage.label(mask)
    if not count:
        return mask
    return np.asarray(label == 1 + np.bincount(label.ravel())[1:].argmax())
