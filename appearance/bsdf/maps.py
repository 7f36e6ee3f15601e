"""The fitted appearance of a head of hair: maps over the scalp-aligned volume, and scalars."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from appearance.scene.hair_appearance import HairAppearance
from appearance.scene.hair_scene import HairScene
from appearance.scene.opaque import opaque
from reconstruction import Mesh, Model, ModelError, Strands
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import Array
from reconstruction.head.scalp_map import ScalpMap, sphere_center


@dataclass(frozen=True, eq=False)
class HairMaps:
    """The parameters of the extended BSDF over a whole head of hair.

    `sigma_a (n_c, w, h, 3)`: absorption per fibre radius; `rotation (n_c, w, h, 2)`: correctives in
    radians about the strand's two transported normals. n_c layers from root to tip, (w, h) cells of
    the scalp's map (u, v). Scalars as in `HairAppearance`. Raises `ValueError` naming the field.
    """

    sigma_a: Array
    rotation: Array
    beta_m: float
    beta_n: float
    eta: float = 1.55
    tilt_deg: float = 2.0

    def __post_init__(self) -> None:
        for name, channels in (("sigma_a", 3), ("rotation", 2)):
            value = np.array(getattr(self, name), float)
            if value.ndim != 4 or value.shape[-1] != channels or 0 in value.shape:
                raise ValueError(f"{name} must be (n_c, w, h, {channels}), got {value.shape}")
            if not np.isfinite(value).all():
                raise ValueError(f"{name} must be finite")
            object.__setattr__(self, name, value)
        self.mean()  # checks the scalars and the absorption's sign

    @classmethod
    def of(cls, hair: HairAppearance, shape: tuple[int, int, int] = (1, 1, 1)) -> HairMaps:
        """Maps of `shape` (n_c, w, h) that are `hair` everywhere: `(n_c, w, h, 3)` and `(…, 2)`."""
        sigma_a, rotation = np.broadcast_to(hair.sigma_a, (*shape, 3)), np.zeros((*shape, 2))
        return cls(sigma_a, rotation, hair.beta_m, hair.beta_n, hair.eta, hair.tilt_deg)

    @classmethod
    def each(cls, hair: HairAppearance, absorption: Array) -> HairMaps:
        """`hair` with `absorption (n_c, S, 3)` of every strand, for `MappedStrands.alone`."""
        return replace(cls.of(hair, (1, len(absorption[0]), 1)), sigma_a=absorption[:, :, None])

    @property
    def shape(self) -> tuple[int, int, int]:
        """(n_c, w, h) of the absorption."""
        layers, columns, rows, _ = self.sigma_a.shape
        return layers, columns, rows

    @property
    def uniform(self) -> bool:
        """Whether they have one cell and no rotation: one material for all hair."""
        return self.shape == (1, 1, 1) and not self.rotation.any()

    def mean(self) -> HairAppearance:
        """One colour for all of it: the mean absorption of the cells."""
        sigma_a = self.sigma_a.reshape(-1, 3)
        if sigma_a.min() < 0:
            raise ValueError(f"sigma_a must not be negative, got {sigma_a.min():g}")
        red, green, blue = sigma_a.mean(axis=0)
        return HairAppearance((red, green, blue), self.beta_m, self.beta_n, self.eta, self.tilt_deg)

    def resized(self, shape: tuple[int, int, int]) -> HairMaps:
        """The same maps with other numbers of layers and cells: linear along strands and scalp."""
        return replace(
            self, sigma_a=_resized(self.sigma_a, shape), rotation=_resized(self.rotation, shape)
        )

    def save(self, model: Model, root_uv: ArrayLike) -> None:
        """Write the maps and the strands' `root_uv (S, 2)` as the model's `hair_maps.npz`."""
        arrays = {
            "sigma_a": self.sigma_a.astype(np.float32),
            "rotation": self.rotation.astype(np.float32),
            "scalars": np.array([self.beta_m, self.beta_n, self.eta, self.tilt_deg]),
            "root_uv": np.asarray(root_uv, np.float32),
        }
        model.write_arrays("hair_maps.npz", arrays)

    @classmethod
    def load(cls, model: Model) -> tuple[HairMaps, Array]:
        """The saved maps, and `root_uv (S, 2)`. Raises `ModelError` for a missing or bad file."""
        data = model.arrays("hair_maps.npz")
        try:
            scalars = [float(x) for x in data["scalars"]]
            maps = cls(data["sigma_a"], data["rotation"], *scalars)
            return maps, np.asarray(data["root_uv"], float)
        except (KeyError, TypeError, ValueError) as error:
            path = model.file("hair_maps.npz")
            raise ModelError(f"{path}: {error!r}: run 'hairstage fit' again") from error


@dataclass(frozen=True, eq=False)
class MappedStrands:
    """The strands of a scene with their coordinates in the volume.

    `root_uv (S, 2)` are the roots on the scalp's map, `coordinates` the BSDF's parameters of the
    curves (`strand_parameters`).
    """

    scene: HairScene
    root_uv: Array
    coordinates: dict[str, Any]

    @classmethod
    def of(cls, scene: HairScene, strands: Strands, root_uv: ArrayLike) -> MappedStrands:
        """`strands` must be those that `scene` was built from."""
        from appearance.bsdf.strand_coordinates import strand_parameters

        shape = mi.traverse(scene.hair_shape)
        coordinates = strand_parameters(
            np.array(shape["control_points"]).reshape(-1, 4),
            np.array(shape["segment_indices"]),
            np.diff(strands.offsets) - 1,
            root_uv,
            root_normals(strands),
        )
        return cls(scene, np.asarray(root_uv, float), coordinates)

    @classmethod
    def alone(cls, scene: HairScene, strands: Strands) -> MappedStrands:
        """Each strand in a cell of its own, of maps with S columns and one row."""
        u = (np.arange(len(strands)) + 0.5) / max(len(strands), 1)
        return cls.of(scene, strands, np.stack([u, np.full(len(u), 0.5)], axis=-1))

    def with_maps(self, maps: HairMaps) -> HairScene:
        """The scene with the maps on its hair; geometry is shared."""
        values = {**_scalars(maps), **_tables(maps), **self.coordinates}
        bsdf = mi.load_dict({"type": "extended_hair", **values})
        return replace(self.scene, hair=maps.mean(), hair_bsdf=bsdf)

    def update_maps(self, scene: HairScene, maps: HairMaps) -> HairScene:
        """`scene`, which `painted` made, with other maps on the same BSDF: `scene` changes too."""
        values = mi.traverse(scene.hair_bsdf)
        scalars = {name: opaque([value])[0] for name, value in _scalars(maps).items()}
        for name, value in {**_tables(maps), **scalars}.items():
            values[name] = value
        values.update()
        return replace(scene, hair=maps.mean())


def _scalars(maps: HairMaps) -> dict[str, float]:
    return {
        "longitudinal_roughness": maps.beta_m,
        "azimuthal_roughness": maps.beta_n,
        "scale_tilt": -maps.tilt_deg,
        "eta": maps.eta,
    }


def _tables(maps: HairMaps) -> dict[str, Any]:
    return {name: mi.TensorXf(for_kernels(getattr(maps, name))) for name in ("sigma_a", "rotation")}


def scalp_coordinates(strands: Strands, head: Mesh | None) -> Array:
    """(u, v) `(S, 2)` of the strands' roots in [0, 1]: on the head's marked scalp where it has one.

    Without a marked scalp, or where its map would fold, Lambert's equal-area map about the middle
    of the roots themselves.
    """
    if head is not None and head.scalp is not None and head.scalp.any():
        with suppress(ValueError):
            return ScalpMap.of(head)(strands.roots.astype(float))[0]
    d = root_normals(strands)
    pole = d.mean(axis=0)
    pole /= max(float(np.linalg.norm(pole)), 1e-12)
    across = np.array([1.0, 0, 0]) if abs(pole[0]) < 0.9 else np.array([0, 1.0, 0])
    right = across - (across @ pole) * pole
    right /= np.linalg.norm(right)
    flat = np.stack([d @ right, d @ np.cross(pole, right)], axis=1)
    flat *= np.sqrt(2 / np.maximum(1 + d @ pole, 1e-3))[:, None]
    low, extent = flat.min(axis=0), np.ptp(flat, axis=0)
    return np.clip((flat - low) / np.maximum(extent, 1e-9), 0, 1)


def root_normals(strands: Strands) -> Array:
    """Unit directions `(S, 3)` from the middle of the roots' sphere through the roots.

    Start of the strands' transported normals; they move with the head.
    """
    roots = strands.roots.astype(float)
    middle = roots.mean(axis=0)
    if len(roots) >= 4 and np.linalg.matrix_rank(roots - middle, 1e-4) == 3:
        middle = sphere_center(roots)
    d = roots - middle
    length = np.linalg.norm(d, axis=1, keepdims=True)
    return np.where(length > 1e-9, d / np.maximum(length, 1e-9), [0.0, 0.0, 1.0])


def _resized(table: Array, shape: tuple[int, int, int]) -> Array:
    """Layers sit at the ends of strands, cells at their own middles."""
    for axis, count in enumerate(shape):
        old = table.shape[axis]
        if old == count:
            continue
        if axis == 0:
            at = np.linspace(0, old - 1, count) if count > 1 else np.array([0.5 * (old - 1)])
        else:
            at = np.clip((np.arange(count) + 0.5) * old / count - 0.5, 0, old - 1)
        low = np.minimum(at.astype(int), max(old - 2, 0))
        share = (at - low).reshape([-1 if k == axis else 1 for k in range(table.ndim)])
        high = np.minimum(low + 1, old - 1)
        table = table.take(low, axis) * (1 - share) + table.take(high, axis) * share
    return table
