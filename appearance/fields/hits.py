"""First hits of camera rays on hair, the points at which fields are evaluated."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from appearance.bsdf.maps import MappedStrands
from appearance.bsdf.parameters import StrandHit
from appearance.render.paths import Surface, jittered, pixel_indices, stream
from appearance.scene.hair_scene import SCALE
from appearance.scene.opaque import opaque_index
from reconstruction import Camera
from reconstruction.array_backend import for_kernels, rows_of
from reconstruction.arrays import Floats, Ints
from reconstruction.files.durable import writing
from reconstruction.options import options

RECORD = np.dtype(
    [
        ("strand", np.int32),
        ("along", np.float32),
        ("weight", np.float32),
        ("point", np.float32, 3),
        ("tangent", np.float32, 3),
        ("normal", np.float32, 3),
    ]
)
"""A hit: 48 bytes. 50 views of 20,000 pixels at 16 hits take 770 MB."""
_AT_ONCE = 1 << 20
"""Rays of a kernel's launch."""


@options
class HitOptions:
    """`count` jittered rays a pixel, and the `seed`."""

    count: Annotated[int, Field(ge=1, le=64)] = 16
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Hits:
    """The first hits of K rays through each of P pixels of `camera`, `pixels (P,)` flat indices.

    `table (P, K)` holds `RECORD`s, in memory or mapped from a file; its columns:

    - `strand`: index of the strand, -1 for other or no hits
    - `along`: 0 at the root to 1 at the tip; with `strand` a point of the hair in every pose
    - `weight`: 1/K on hair, 0 elsewhere
    - `point`: metres, in the traced pose
    - `tangent`, `normal`: orthogonal unit vectors, towards the tip and the transported normal
    """

    camera: Camera
    pixels: Ints
    table: NDArray[np.void]

    def column(self, name: str) -> NDArray[Any]:
        """One column `(P, K)` or `(P, K, 3)`, read into memory."""
        return np.ascontiguousarray(self.table[name])

    @property
    def count(self) -> int:
        """K."""
        return int(self.table.shape[1])

    def towards_camera(self) -> Floats:
        """Unit directions from the hits to the camera `(P, K, 3)`, undefined off the hair."""
        return _unit(self.camera.center - self.column("point"))

    def middle(self) -> Floats:
        """The mean point of each pixel's hits on hair `(P, 3)`, metres; of all pixels for a pixel
        without hits, a metre ahead of the camera without any."""
        weight = self.column("weight")
        total = np.einsum("pk,pki->pi", weight, self.column("point"))
        share = weight.sum(axis=1, keepdims=True)
        out = np.empty_like(total)
        out[:] = self.camera.center + self.camera.R[2]
        if share.any():
            out[:] = total.sum(axis=0) / share.sum()
        return np.divide(total, share, out=out, where=share > 0)


def find_hits(
    mapped: MappedStrands,
    camera: Camera,
    pixels: ArrayLike,
    options: HitOptions | None = None,
    folder: Path | None = None,
) -> Hits:
    """The first hits of rays through the flat `pixels (P,)` on the strands of `mapped`.

    With a `folder` they are a memory-mapped file there, reused for the same strands, camera, pixels
    and options. Raises `ValueError` for pixels outside the image.
    """
    options, index = options or HitOptions(), pixel_indices(camera, pixels)
    shape = (len(index), options.count)
    if folder is None:
        table = np.empty(shape, RECORD)
        _trace(mapped, camera, index, options, table)
        return Hits(camera, index, table)
    file = folder / f"{camera.name}-{_fingerprint(mapped, camera, index, options)}.npy"
    if not file.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        with writing(file) as part:
            made = np.lib.format.open_memmap(part, mode="w+", dtype=RECORD, shape=shape)
            _trace(mapped, camera, index, options, made)
            made.flush()
    return Hits(camera, index, np.load(file, mmap_mode="r"))


def _trace(
    mapped: MappedStrands, camera: Camera, index: Ints, options: HitOptions, out: NDArray[np.void]
) -> None:
    count = options.count
    surface = Surface(mapped.scene)
    each = max(1, _AT_ONCE // count)
    for start in range(0, len(index), each):
        part = index[start : start + each]
        lane = dr.arange(mi.UInt32, len(part) * count)
        slot = lane // opaque_index(count)
        flat = dr.gather(mi.UInt32, mi.UInt32(for_kernels(part, np.uint32)), slot)
        rng = stream(len(part) * count, options.seed, start)
        ray = jittered(camera, flat, lane - slot * opaque_index(count), count, rng)
        si = surface.interact(ray, mi.Bool(True))
        hair = si.is_valid() & surface.is_hair(si)
        hit = StrandHit(mapped.coordinates, si, hair)
        across = hit.tangent
        tangent = si.to_world(mi.Vector3f(across[0], across[1], 0))
        normal = dr.normalize(hit.normal - tangent * dr.dot(hit.normal, tangent))
        dr.eval(si, hair, tangent, normal)  # one tracing for all
        rows = out[start : start + len(part)]
        for name, value in (("point", si.p / SCALE), ("tangent", tangent), ("normal", normal)):
            rows[name] = rows_of(dr.select(hair, value, 0)).reshape(*rows.shape, 3)
        rows["along"] = np.array(dr.select(hair, hit.along, 0)).reshape(rows.shape)
        on_hair = np.array(hair).reshape(rows.shape)
        strand = np.array(hit.strand).reshape(rows.shape).astype(np.int64)
        rows["strand"] = np.where(on_hair, strand, -1)
        rows["weight"] = on_hair / np.float32(count)


def _fingerprint(mapped: MappedStrands, camera: Camera, index: Ints, options: HitOptions) -> str:
    """Of everything that the hits depend on."""
    total = hashlib.sha256(repr((camera.to_dict(), options)).encode())
    head = mapped.scene.head_shape
    arrays = [np.array(mapped.coordinates[name]) for name in ("control_points", "segment_indices")]
    if head is not None:
        arrays.append(np.array(mi.traverse(head)["vertex_positions"]))
    for array in (index, *arrays):
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()[:16]


def _unit(v: ArrayLike) -> Floats:
    v = np.asarray(v, np.float32)
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.divide(v, length, out=np.zeros_like(v), where=length > 0)
